#include "server/store/store.h"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/statvfs.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdio>
#include <filesystem>
#include <set>
#include <utility>

#include "absl/strings/numbers.h"
#include "core/base/status.h"
#include "server/store/schema.h"

namespace metaekf::store {
namespace {

std::string DatabasePath(const std::string& directory) { return directory + "/metaekf.db"; }
std::string JobsDirectory(const std::string& directory) { return directory + "/jobs"; }

/// Locks the directory for this process; the lock goes with the descriptor.
absl::StatusOr<UniqueFd> Lock(const std::string& directory) {
  UniqueFd file(open((directory + "/lock").c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0600));
  if (!file.valid()) {
    return ErrnoStatus(errno, absl::StrCat("cannot write to the data directory ", directory));
  }
  if (flock(file.get(), LOCK_EX | LOCK_NB) != 0) {
    return absl::FailedPreconditionError(
        absl::StrCat("the data directory ", directory,
                     " is in use by another server; stop that one or use another directory"));
  }
  return file;
}

/// In format 1, before jobs had tenants, their directories were named by the number alone.
absl::Status RenameOldJobDirectories(const std::string& jobs_directory) {
  METAEKF_ASSIGN_OR_RETURN(const auto names, ListDirectory(jobs_directory));
  for (const std::string& name : names) {
    int64_t number = 0;
    if (!absl::SimpleAtoi(name, &number)) continue;
    const std::string to = JobDirectoryName(kDefaultTenant, number);
    if (rename((jobs_directory + "/" + name).c_str(), (jobs_directory + "/" + to).c_str()) != 0) {
      return ErrnoStatus(errno, absl::StrCat("cannot rename the directory of job ", number));
    }
  }
  return absl::OkStatus();
}

/// A new database beside old files would have them removed as garbage.
absl::Status CheckDatabaseNotLost(const std::string& directory, const BlobStore& blobs) {
  if (access(DatabasePath(directory).c_str(), F_OK) == 0) return absl::OkStatus();
  METAEKF_ASSIGN_OR_RETURN(const auto files, blobs.List());
  if (files.empty()) return absl::OkStatus();
  return absl::DataLossError(
      absl::StrCat(directory, " has ", files.size(),
                   " stored files but no metaekf.db; restore that file from a ",
                   "backup, or remove the directory to start anew"));
}

absl::Status CountRows(Connection& connection, const std::string& tenant, Inventory& inventory) {
  const auto of = [](const std::string& table) {
    return absl::StrCat(" FROM ", table, " WHERE (?1 = '' OR tenant = ?1)");
  };
  return connection.Execute(
      absl::StrCat("SELECT count(DISTINCT tenant || '/' || model), count(*), (SELECT count(*)",
                   of("adaptations"), "), (SELECT count(*)", of("jobs"),
                   " AND state = 'QUEUED'), (SELECT count(*)", of("jobs"),
                   " AND state = 'RUNNING'), (SELECT count(*)", of("jobs"), "), (SELECT count(*)",
                   of("sessions"), "), total(size_bytes) + (SELECT total(size_bytes)",
                   of("adaptations"), ")", of("versions")),
      {tenant}, [&](const Row& row) {
        inventory.models = row.Int(0);
        inventory.versions = row.Int(1);
        inventory.adaptations = row.Int(2);
        inventory.queued_jobs = row.Int(3);
        inventory.running_jobs = row.Int(4);
        inventory.ended_jobs = row.Int(5) - row.Int(3) - row.Int(4);
        inventory.sessions = row.Int(6);
        inventory.stored_bytes = row.Int(7);
      });
}

using OwnedFiles = std::vector<std::pair<std::string, std::string>>;  // owner, digest

absl::StatusOr<OwnedFiles> ListFiles(Connection& connection, const std::string& tenant) {
  OwnedFiles files;
  METAEKF_RETURN_IF_ERROR(connection.Execute(
      "SELECT 'model ''' || model || ''' version ' || version, digest FROM versions "
      "WHERE (?1 = '' OR tenant = ?1) "
      "UNION ALL SELECT 'adaptation ''' || id || '''', digest FROM adaptations "
      "WHERE (?1 = '' OR tenant = ?1) "
      "UNION ALL SELECT 'the data of job ' || number, dataset_digest FROM jobs "
      "WHERE (?1 = '' OR tenant = ?1) AND state IN ('QUEUED', 'RUNNING')",
      {tenant}, [&](const Row& row) { files.emplace_back(row.Text(0), row.Text(1)); }));
  return files;
}

}  // namespace

absl::StatusOr<std::unique_ptr<Store>> Store::Open(const std::string& directory, Clock clock,
                                                    const Quotas& quotas) {
  METAEKF_RETURN_IF_ERROR(MakeDirectory(directory));
  METAEKF_ASSIGN_OR_RETURN(UniqueFd lock, Lock(directory));
  METAEKF_ASSIGN_OR_RETURN(BlobStore blobs, BlobStore::Open(directory));
  METAEKF_RETURN_IF_ERROR(CheckDatabaseNotLost(directory, blobs));
  METAEKF_RETURN_IF_ERROR(MakeDirectory(JobsDirectory(directory)));
  METAEKF_RETURN_IF_ERROR(RenameOldJobDirectories(JobsDirectory(directory)));
  auto database = Database::Open(DatabasePath(directory));
  if (!database.ok()) return base::Annotate(database.status(), directory);
  METAEKF_RETURN_IF_ERROR(base::Annotate(PrepareSchema(**database), directory));
  std::unique_ptr<Store> store(new Store(directory, std::move(lock), std::move(blobs),
                                         *std::move(database), std::move(clock), quotas));
  METAEKF_RETURN_IF_ERROR(store->CollectGarbage());
  return store;
}

Store::Store(const std::string& directory, UniqueFd lock, BlobStore blobs,
             std::unique_ptr<Database> database, Clock clock, const Quotas& quotas)
    : directory_(directory),
      quotas_(quotas),
      lock_(std::move(lock)),
      blobs_(std::move(blobs)),
      database_(std::move(database)),
      context_{*database_, blobs_, std::move(clock), JobsDirectory(directory), "", "server"},
      job_queue_(context_, quotas_),
      audit_(context_) {}

TenantStore Store::Of(const std::string& tenant, const std::string& identity) {
  Context context = context_;
  context.tenant = tenant;
  context.identity = identity;
  context.quota = quotas_.Of(tenant);
  return TenantStore(context);
}

TokenStore Store::Tokens(const std::string& identity) {
  Context context = context_;
  context.identity = identity;
  return TokenStore(context);
}

absl::StatusOr<std::vector<bool>> Store::SaveCheckpoints(
    const std::vector<SessionCheckpoint>& checkpoints) {
  return store::SaveCheckpoints(*database_, checkpoints);
}

absl::Status Store::CollectGarbage() {
  return database_->Write([&](Connection& connection) -> absl::Status {
    METAEKF_ASSIGN_OR_RETURN(const auto referenced, ReferencedBlobs(connection));
    const std::set<std::string> keep(referenced.begin(), referenced.end());
    METAEKF_ASSIGN_OR_RETURN(const auto files, blobs_.List());
    for (const std::string& digest : files) {
      if (!keep.contains(digest)) blobs_.Remove(digest);
    }

    // Failed ones keep their last checkpoint.
    std::set<std::string> keep_directory;
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        "SELECT tenant, number FROM jobs WHERE state IN ('QUEUED', 'RUNNING', 'FAILED')", {},
        [&](const Row& row) { keep_directory.insert(JobDirectoryName(row.Text(0), row.Int(1))); }));
    METAEKF_ASSIGN_OR_RETURN(const auto directories, ListDirectory(context_.jobs_directory));
    for (const std::string& name : directories) {
      if (keep_directory.contains(name)) continue;
      std::error_code ignored;  // the next start tries again
      std::filesystem::remove_all(absl::StrCat(context_.jobs_directory, "/", name), ignored);
    }
    return absl::OkStatus();
  });
}

absl::StatusOr<std::unique_ptr<Backup>> Store::MakeBackup(const std::string& identity) {
  std::string directory = directory_ + "/tmp/backup-XXXXXX";
  if (mkdtemp(directory.data()) == nullptr) return ErrnoStatus(errno, "cannot make a directory for the backup");
  auto backup = std::make_unique<Backup>(directory);
  METAEKF_RETURN_IF_ERROR(MakeDirectory(directory + "/blobs"));
  Context context = context_;
  context.identity = identity;
  METAEKF_RETURN_IF_ERROR(database_->Write(
      [&](Connection& connection) { return Audit(context, connection, "CreateBackup", "backup"); }));

  std::vector<std::string> digests;
  METAEKF_RETURN_IF_ERROR(database_->CopyTo(DatabasePath(directory), [&](Connection& connection) -> absl::Status {
    METAEKF_ASSIGN_OR_RETURN(digests, ReferencedBlobs(connection));
    for (const std::string& digest : digests) {
      // One that is gone is missed by whoever reads the backup.
      const std::string to = absl::StrCat(directory, "/blobs/", digest);
      if (link(blobs_.Path(digest).c_str(), to.c_str()) != 0 && errno != ENOENT) {
        return ErrnoStatus(errno, "cannot keep a file for the backup");
      }
    }
    return absl::OkStatus();
  }));
  METAEKF_ASSIGN_OR_RETURN(const std::string database, ReadFile(DatabasePath(directory)));
  backup->files_.push_back({"metaekf.db", static_cast<int64_t>(database.size()), Sha256Hex(database)});
  for (const std::string& digest : digests) {
    std::error_code gone;
    const uintmax_t size = std::filesystem::file_size(absl::StrCat(directory, "/blobs/", digest), gone);
    backup->files_.push_back({absl::StrCat("blobs/", digest), gone ? 0 : static_cast<int64_t>(size), digest});
  }
  return backup;
}

absl::StatusOr<std::map<std::string, Usage>> Store::TakeUsage() {
  using Usages = std::map<std::string, Usage>;
  return database_->Read([](Connection& connection) -> absl::StatusOr<Usages> {
    Usages usages;
    METAEKF_RETURN_IF_ERROR(connection.Execute("SELECT tenant, count(*) FROM sessions GROUP BY tenant", {},
                                               [&](const Row& row) { usages[row.Text(0)].sessions = row.Int(1); }));
    METAEKF_RETURN_IF_ERROR(connection.Execute("SELECT tenant, count(*), total(size_bytes) FROM adaptations GROUP BY tenant", {},
                                               [&](const Row& row) {
                                                 usages[row.Text(0)].adaptations = row.Int(1);
                                                 usages[row.Text(0)].stored_bytes += row.Int(2);
                                               }));
    METAEKF_RETURN_IF_ERROR(connection.Execute("SELECT tenant, count(*), total(size_bytes) FROM versions GROUP BY tenant", {},
                                               [&](const Row& row) {
                                                 usages[row.Text(0)].versions = row.Int(1);
                                                 usages[row.Text(0)].stored_bytes += row.Int(2);
                                               }));
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        "SELECT tenant, total(state = 'QUEUED'), total(state = 'RUNNING') FROM jobs "
        "WHERE state IN ('QUEUED', 'RUNNING') GROUP BY tenant",
        {}, [&](const Row& row) {
          usages[row.Text(0)].queued_jobs = row.Int(1);
          usages[row.Text(0)].running_jobs = row.Int(2);
        }));
    return usages;
  });
}

absl::StatusOr<Inventory> Store::TakeInventory(const std::string& tenant, bool verify_files) {
  Inventory inventory;
  inventory.format_version = kFormatVersion;
  METAEKF_ASSIGN_OR_RETURN(
      const auto files, database_->Read([&](Connection& connection) -> absl::StatusOr<OwnedFiles> {
        METAEKF_RETURN_IF_ERROR(CountRows(connection, tenant, inventory));
        return ListFiles(connection, tenant);
      }));
  OwnedFiles damaged;
  std::vector<std::string> problems;
  for (const auto& [owner, digest] : files) {
    if (!verify_files && access(blobs_.Path(digest).c_str(), R_OK) == 0) continue;
    const absl::Status status = blobs_.Read(digest, owner).status();
    if (status.ok()) continue;
    damaged.emplace_back(owner, digest);
    problems.emplace_back(status.message());
  }
  if (!damaged.empty()) {
    // What was removed while it was looked at is none.
    METAEKF_ASSIGN_OR_RETURN(const OwnedFiles still, database_->Read([&](Connection& connection) { return ListFiles(connection, tenant); }));
    for (size_t i = 0; i < damaged.size(); ++i) {
      if (std::find(still.begin(), still.end(), damaged[i]) != still.end()) inventory.problems.push_back(std::move(problems[i]));
    }
  }
  struct statvfs disk {};
  if (statvfs(directory_.c_str(), &disk) != 0)
    return ErrnoStatus(errno, "cannot ask for free disk");
  inventory.free_disk_bytes = static_cast<int64_t>(disk.f_bavail * disk.f_frsize);
  return inventory;
}

}  // namespace metaekf::store
