// Kills a process that writes to a store, again and again, and looks at what it left.

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <csignal>
#include <map>
#include <set>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/rng.h"
#include "tests/server/store/test_store.h"

namespace metaekf::store {
namespace {

using ::testing::IsEmpty;
using ::testing::UnorderedElementsAreArray;

constexpr int kRounds = 60;

absl::Time Now() { return absl::Now(); }

/// What the writer tells the test: a version that it has added, or is about to delete.
struct Report {
  enum Kind : int64_t { kAdded, kDeleting } kind;
  int64_t model;
  int64_t version;
};

/// A process that does everything a server does to its store, in random order, until it is killed.
class Writer {
 public:
  Writer(Store& store, uint64_t seed, int report_fd)
      : store_(store), rng_(seed), report_fd_(report_fd) {}

  void Step() {
    switch (rng_.Index(5)) {
      case 0:
      case 1:
        return AddVersion();
      case 2:
        return DeleteVersion();
      case 3:
        return Adapt();
      default:
        return Train();
    }
  }

 private:
  static std::string ModelName(int64_t model) { return absl::StrCat("m", model); }

  StagedBlob RandomBlob(size_t max_bytes) {
    std::string bytes(1 + rng_.Index(max_bytes), '\0');
    for (size_t i = 0; i + 8 <= bytes.size(); i += 8) {
      const uint64_t bits = rng_.NextBits();
      bytes.replace(i, 8, reinterpret_cast<const char*>(&bits), 8);
    }
    return store_.blobs().Stage(bytes).value();
  }

  void Tell(const Report& report) {
    if (write(report_fd_, &report, sizeof(report)) != sizeof(report)) _exit(2);
  }

  void AddVersion() {
    const auto model = static_cast<int64_t>(rng_.Index(3));
    const auto version =
        store_.Of(kDefaultTenant).models().AddVersion(ModelName(model), RandomBlob(200'000), "{}").value();
    Tell({Report::kAdded, model, version.version});
  }

  void DeleteVersion() {
    const auto model = static_cast<int64_t>(rng_.Index(3));
    const auto latest = store_.Of(kDefaultTenant).models().GetLatest(ModelName(model));
    if (!latest.ok()) return;
    Tell({Report::kDeleting, model, latest->version});
    store_.Of(kDefaultTenant).models()
        .DeleteVersion(ModelName(model), latest->version)
        .IgnoreError();  // may be in use
  }

  void Adapt() {
    const auto latest = store_.Of(kDefaultTenant).models().GetLatest("m0");
    if (!latest.ok()) return;
    const auto adaptation = store_.Of(kDefaultTenant).adaptations()
                                .Create({"", "m0", latest->version, RandomBlob(20'000), "{}", {}})
                                .value();
    if (rng_.Index(2) == 0) store_.Of(kDefaultTenant).adaptations().Delete(adaptation.id).IgnoreError();
  }

  void Train() {
    if (!store_.Of(kDefaultTenant).jobs().Create({"trained", "{}", RandomBlob(100'000), {}}).ok()) _exit(3);
    const auto job = store_.job_queue().Claim("writer", absl::Seconds(30)).value();
    const JobLease lease = job->lease;
    store_.job_queue().WorkDirectory(lease).value();
    if (!store_.job_queue().Renew(lease, absl::Seconds(30), "{}", true).ok()) _exit(4);
    if (!store_.job_queue().Publish(lease, RandomBlob(100'000), absl::StrCat(lease.number)).ok())
      _exit(5);
  }

  Store& store_;
  base::Rng rng_;
  int report_fd_;
};

[[noreturn]] void RunWriter(const std::string& directory, uint64_t seed, int report_fd) {
  auto store = Store::Open(directory, Now);
  if (!store.ok() || !(*store)->job_queue().GiveBackAll().ok()) _exit(1);
  Writer writer(**store, seed, report_fd);
  while (true) writer.Step();
}

/// Versions that must be there (added, and no deletion begun), per model.
using Confirmed = std::map<int64_t, std::set<int64_t>>;

void Apply(const Report& report, Confirmed& confirmed) {
  if (report.kind == Report::kAdded) {
    confirmed[report.model].insert(report.version);
  } else {
    confirmed[report.model].erase(report.version);
  }
}

/// Starts a writer, lets it make `reports` reports and go on for `extra`, and kills it.
void RunAndKill(const std::string& directory, uint64_t seed, uint64_t reports,
                std::chrono::microseconds extra, Confirmed& confirmed) {
  int ends[2];
  ASSERT_EQ(pipe(ends), 0);
  const pid_t writer = fork();
  ASSERT_GE(writer, 0);
  if (writer == 0) {
    close(ends[0]);
    RunWriter(directory, seed, ends[1]);
  }
  close(ends[1]);
  Report report{};
  for (uint64_t i = 0; i < reports; ++i) {
    if (read(ends[0], &report, sizeof(report)) != sizeof(report)) break;
    Apply(report, confirmed);
  }
  // The moment of death is what varies here, so there is no event to wait for.
  const auto death = std::chrono::steady_clock::now() + extra;
  while (std::chrono::steady_clock::now() < death) {
  }
  kill(writer, SIGKILL);
  int status = 0;
  waitpid(writer, &status, 0);
  EXPECT_TRUE(WIFSIGNALED(status)) << "the writer ended by itself: " << WEXITSTATUS(status);
  while (read(ends[0], &report, sizeof(report)) == sizeof(report)) Apply(report, confirmed);
  close(ends[0]);
}

std::vector<ModelVersion> AllVersions(Store& store, const std::string& model) {
  const auto page = store.Of(kDefaultTenant).models().ListVersions(model, {1000, ""});
  return page.ok() ? page->items : std::vector<ModelVersion>();
}

/// Every file is whole and belongs to a row; nothing else lies about.
void CheckFiles(Store& store, const std::string& directory) {
  EXPECT_THAT(store.TakeInventory("", true)->problems, IsEmpty());
  EXPECT_THAT(*ListDirectory(directory + "/tmp"), IsEmpty());
  std::set<std::string> expected;
  std::set<std::string> with_directory;
  for (const char* model : {"m0", "m1", "m2", "trained"}) {
    for (const auto& version : AllVersions(store, model)) {
      EXPECT_TRUE(store.Of(kDefaultTenant).models().ReadFile(version).ok());
      expected.insert(version.digest);
    }
  }
  const auto adaptations = store.Of(kDefaultTenant).adaptations().List({1000, ""}).value();
  for (const auto& adaptation : adaptations.items) expected.insert(adaptation.digest);
  const auto jobs = store.Of(kDefaultTenant).jobs().List({1000, ""}).value();
  for (const auto& job : jobs.items) {
    const bool active = job.state == JobState::kQueued || job.state == JobState::kRunning;
    if (active) expected.insert(job.dataset_digest);
    if (active || job.state == JobState::kFailed) {
      with_directory.insert(JobDirectoryName(kDefaultTenant, job.number));
    }
  }
  EXPECT_THAT(*ListDirectory(directory + "/blobs"), UnorderedElementsAreArray(expected));
  EXPECT_THAT(*ListDirectory(directory + "/jobs"), testing::IsSubsetOf(with_directory));
}

/// A job has succeeded if and only if there is exactly one version that says it is the job's.
void CheckJobs(Store& store) {
  std::map<std::string, int> versions_of_job;
  for (const auto& version : AllVersions(store, "trained")) {
    ++versions_of_job[version.metadata_json];
  }
  const auto jobs = store.Of(kDefaultTenant).jobs().List({1000, ""}).value();
  for (const auto& job : jobs.items) {
    EXPECT_EQ(versions_of_job[absl::StrCat(job.number)], job.state == JobState::kSucceeded)
        << job.number;
  }
}

TEST(CrashTest, NothingConfirmedIsLostAndNothingHalfMadeIsLeft) {
  TempDirectory directory;
  base::Rng rng(2024);
  Confirmed confirmed;
  for (int round = 0; round < kRounds && !testing::Test::HasFailure(); ++round) {
    SCOPED_TRACE(absl::StrCat("round ", round));
    const uint64_t reports = 1 + rng.Index(8);
    const std::chrono::microseconds extra(rng.Index(20'000));
    RunAndKill(directory.path(), rng.NextBits(), reports, extra, confirmed);

    auto store = Store::Open(directory.path(), Now);
    ASSERT_TRUE(store.ok()) << store.status();
    CheckFiles(**store, directory.path());
    CheckJobs(**store);
    for (const auto& [model, versions] : confirmed) {
      for (const int64_t version : versions) {
        TenantStore mine = (*store)->Of(kDefaultTenant);
        EXPECT_TRUE(mine.models().GetVersion(absl::StrCat("m", model), version).ok())
            << "m" << model << " version " << version;
      }
    }
  }
}

}  // namespace
}  // namespace metaekf::store
