#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "server/store/audit.h"
#include "server/store/backup.h"
#include "server/store/blob_store.h"
#include "server/store/context.h"
#include "server/store/files.h"
#include "server/store/tenant_store.h"
#include "server/store/tokens.h"

namespace metaekf::store {

/// Whose everything is where clients are not told apart.
inline constexpr const char* kDefaultTenant = "default";

/// What is in a data directory, and what is wrong with it.
struct Inventory {
  int64_t format_version = 0;
  int64_t models = 0;
  int64_t versions = 0;
  int64_t adaptations = 0;
  int64_t queued_jobs = 0;
  int64_t running_jobs = 0;
  int64_t ended_jobs = 0;
  int64_t sessions = 0;
  int64_t stored_bytes = 0;  ///< in model files and adaptations
  int64_t free_disk_bytes = 0;
  std::vector<std::string> problems;  ///< one sentence per file that is damaged or gone
};

/// What a tenant has.
struct Usage {
  int64_t sessions = 0;
  int64_t adaptations = 0;
  int64_t versions = 0;
  int64_t stored_bytes = 0;  ///< in model files and adaptations
  int64_t queued_jobs = 0;
  int64_t running_jobs = 0;
};

/// A data directory, owned by one process: rows in an SQLite database, contents in files named by
/// their digest. Whatever moment the process is killed at, the next Open finds every change that
/// was confirmed, none half made, and removes files that nothing refers to.
///
///   DIR/lock         held while the store is open
///   DIR/metaekf.db   the database
///   DIR/blobs/       model files, adaptations, data of jobs
///   DIR/tmp/         files being written
///   DIR/jobs/T-N/    work directory of job N of tenant T
class Store {
 public:
  /// Makes the directory if there is none (its parent must exist).
  /// Errors: FailedPrecondition if another process has it open, it cannot be written, or it is of
  /// another format; DataLoss if the database is damaged or gone while files are still there.
  static absl::StatusOr<std::unique_ptr<Store>> Open(const std::string& directory, Clock clock,
                                                     const Quotas& quotas = {});

  /// What a tenant has, for a client of it. @param identity  of the client, for the audit log.
  TenantStore Of(const std::string& tenant, const std::string& identity = "");
  JobQueue& job_queue() { return job_queue_; }
  /// For who looks after the server. @param identity  as above.
  TokenStore Tokens(const std::string& identity = "");
  AuditLog& audit() { return audit_; }
  const BlobStore& blobs() const { return blobs_; }

  /// Writes checkpoints of sessions: as SaveCheckpoints.
  absl::StatusOr<std::vector<bool>> SaveCheckpoints(
      const std::vector<SessionCheckpoint>& checkpoints);

  /// All that is there now, of all tenants, but for the checkpoints of training jobs, which begin anew from it. Writes wait
  /// for milliseconds. @param identity  for the audit log. Errors: ResourceExhausted when the disk is full.
  absl::StatusOr<std::unique_ptr<Backup>> MakeBackup(const std::string& identity);

  /// Of all tenants that have anything.
  absl::StatusOr<std::map<std::string, Usage>> TakeUsage();

  /// @param tenant  whose things are counted and looked at; empty: everyone's.
  /// @param verify_files  reads every file and compares its digest; else only looks whether it is
  /// there.
  absl::StatusOr<Inventory> TakeInventory(const std::string& tenant, bool verify_files);

 private:
  Store(const std::string& directory, UniqueFd lock, BlobStore blobs,
        std::unique_ptr<Database> database, Clock clock, const Quotas& quotas);
  absl::Status CollectGarbage();

  const std::string directory_;
  const Quotas quotas_;
  UniqueFd lock_;
  BlobStore blobs_;
  std::unique_ptr<Database> database_;
  Context context_;  // of the server itself
  JobQueue job_queue_;
  AuditLog audit_;
};

}  // namespace metaekf::store
