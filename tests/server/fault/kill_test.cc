// kill -9 of the server at seeded moments of training, adaptation and upload: it starts again,
// every model listed loads, nothing half made is listed, and the job goes on. A moment is a number of changes in the data
// directory: kills hit where something is being written, and a slow machine gets as far as a quick one.
//
// METAEKF_FAULTS=long: 200 kills of jobs instead of 20.

#include <sys/types.h>

#include <csignal>
#include <functional>
#include <thread>

#include "core/base/rng.h"
#include "server/store/database.h"
#include "tests/server/support/directory_changes.h"
#include "tests/server/support/server_process.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"
#include "tests/server/support/workers.h"
#include "tests/support/faults.h"

namespace metaekf::server {
namespace {

using ::testing::IsEmpty;
using ::testing::SizeIs;

constexpr int kRounds = 20;
// Changes within which a kill comes: several uploads, adaptations or checkpoints.
constexpr uint64_t kUploadChanges = 60, kAdaptationChanges = 80, kTrainingChanges = 30;

class KillTest : public ::testing::Test {
 protected:
  /// Starts a server, repeats `piece` against it, and kills it after so many changes; returns how many pieces were confirmed.
  int KillAfter(size_t changes, const std::function<bool(Client&)>& piece) {
    ServerProcess server = ServerProcess::Metaekfd(directory_.path(), config_);
    EXPECT_NE(server.address(), "") << "the server did not start";
    if (HasFailure()) return 0;
    Client client(server.address());
    DirectoryChanges seen(directory_.path());
    int confirmed = 0;
    std::thread worker([&] {
      while (piece(client)) ++confirmed;
    });
    EXPECT_TRUE(seen.Wait(changes)) << "the pieces came to an end before the kill";
    EXPECT_EQ(server.End(SIGKILL).signal, SIGKILL);
    worker.join();
    return confirmed;
  }

  /// Runs `work` against a server that then ends in peace.
  void WithServer(const std::function<void(Client&)>& work) {
    ServerProcess server = ServerProcess::Metaekfd(directory_.path(), config_);
    ASSERT_NE(server.address(), "") << "the server did not start";
    {
      Client client(server.address());  // gone before the end: a connection that nobody polls makes the server wait
      work(client);
    }
    EXPECT_EQ(server.End(SIGTERM).code, 0);
  }

  /// Everything that is listed is whole: files match their digests, models load and predict.
  void CheckEverything(Client& client) {
    v1::GetServerInfoRequest verify;
    verify.set_verify_files(true);
    const auto info = client.Call(verify);
    ASSERT_TRUE(info.ok()) << info;
    EXPECT_THAT(info.value.data_directory().problems(), IsEmpty());
    const auto models = client.Call(v1::ListModelsRequest());
    for (const v1::Model& model : models.value.models()) {
      v1::ListModelVersionsRequest list;
      list.set_parent(model.name());
      list.set_page_size(1000);
      const auto versions = client.Call(list);
      for (const auto& version : versions.value.model_versions()) {
        CheckLoads(client, version.name());
      }
    }
    v1::ListAdaptationsRequest list;
    list.set_page_size(1000);
    const auto adaptations = client.Call(list);
    for (const auto& adaptation : adaptations.value.adaptations()) {
      CheckLoads(client, adaptation.name());
    }
    // A job that goes on may publish at this moment; what was left half made would stay.
    const auto temporary = [this] { return *store::ListDirectory(directory_.path() + "/tmp"); };
    const absl::Time soon = absl::Now() + absl::Seconds(10);
    while (!temporary().empty() && absl::Now() < soon) std::this_thread::yield();
    EXPECT_THAT(temporary(), IsEmpty());
  }

  void CheckLoads(Client& client, const std::string& target) {
    std::vector<v1::PredictRequest> requests(2);
    requests[0].mutable_header()->set_target(target);
    requests[0].mutable_header()->set_mode(v1::PredictRequest::ONE_STEP);
    *requests[1].mutable_samples() = TinyContext(10);
    const auto reply = client.Predict(requests);
    EXPECT_TRUE(reply.ok()) << target << ": " << reply;
  }

  void SetUp() override {
    config_ = directory_.path() + "/../" +
              ::testing::UnitTest::GetInstance()->current_test_info()->name() + ".textproto";
    std::ofstream(config_) << "training { threads_per_job: 1 checkpoint_period_s: 0.02 }";
  }
  void TearDown() override { std::remove(config_.c_str()); }

  store::TempDirectory directory_;
  std::string config_;
};

/// Attempts at a job that were lost since the last checkpoint that the server heard of.
int64_t LostInARow(const std::string& data_directory, int64_t job) {
  const auto database = store::Connection::Open(data_directory + "/metaekf.db", store::Connection::Mode::kReadOnly);
  EXPECT_TRUE(database.ok()) << database.status();
  int64_t lost = 0;
  EXPECT_TRUE((*database)->Execute("SELECT failures FROM jobs WHERE number = ?1", {job}, [&](const store::Row& row) { lost = row.Int(0); }).ok());
  return lost;
}

bool IsOpen(const v1::Job& job) { return job.state() == v1::Job::RUNNING || job.state() == v1::Job::QUEUED; }

// Server and worker in turn, at any moment of jobs that follow each other.
TEST_F(KillTest, EachJobPublishesOneVersionWithTheBitsOfAnUndisturbedOne) {
  const int kills = metaekf::testing::LongFaults() ? 200 : kRounds;
  constexpr uint32_t kIterations = 1500;
  std::string undisturbed;
  WithServer([&](Client& client) {
    ASSERT_TRUE(client.CreateJob(TinyJob("undisturbed", kIterations)).ok());
    ASSERT_EQ(client.Watch("jobs/1").value.back().state(), v1::Job::SUCCEEDED);
    undisturbed = client.Call(Named<v1::GetModelVersionRequest>("models/undisturbed")).value.sha256();
  });
  base::Rng rng(2025);
  int jobs = 0;
  for (int kill = 0; kill < kills && !HasFailure();) {
    SCOPED_TRACE(kill);
    ServerProcess server = ServerProcess::Metaekfd(directory_.path(), config_);
    ASSERT_NE(server.address(), "") << "the server did not start";
    Client client(server.address());
    CheckEverything(client);
    const v1::Job latest = client.Call(v1::ListJobsRequest()).value.jobs(0);
    if (!IsOpen(latest)) {
      ASSERT_EQ(latest.state(), v1::Job::SUCCEEDED) << latest.error_message();
      ASSERT_TRUE(client.CreateJob(TinyJob(absl::StrCat("robot", ++jobs), kIterations)).ok());
    }
    // Or less, if the job comes to its end before: there is nothing more to see then.
    (void)DirectoryChanges(directory_.path()).Wait(1 + rng.Index(kTrainingChanges), absl::Milliseconds(500));
    const pid_t worker = WorkerOf(server.pid());
    if (kill % 2 == 1 && worker > 0) {
      // Then the server hears of one checkpoint at least before the next: a job that gets nowhere is given up, rightly.
      ::kill(worker, SIGKILL);
      const auto goes_on = [&] {
        const v1::Job job = client.Call(Named<v1::GetJobRequest>(absl::StrCat("jobs/", jobs + 1))).value;
        return !IsOpen(job) || (job.state() == v1::Job::RUNNING && LostInARow(directory_.path(), jobs + 1) == 0);
      };
      while (!goes_on()) std::this_thread::yield();
      ++kill;
    }
    EXPECT_EQ(server.End(SIGKILL).signal, SIGKILL);
    ++kill;
  }
  ASSERT_GT(jobs, 0);
  WithServer([&](Client& client) {
    for (int job = 1; job <= jobs; ++job) {
      const std::string model = absl::StrCat("models/robot", job);
      const v1::WatchJobResponse last = client.Watch(absl::StrCat("jobs/", job + 1)).value.back();
      EXPECT_EQ(last.state(), v1::Job::SUCCEEDED) << last.error_message();
      EXPECT_EQ(client.Call(Named<v1::GetModelRequest>(model)).value.version_count(), 1u);
      EXPECT_EQ(client.Call(Named<v1::GetModelVersionRequest>(model)).value.sha256(), undisturbed);
    }
  });
}

TEST_F(KillTest, NothingHalfMadeIsListedAfterKillsDuringUploads) {
  int confirmed = 0;
  WithServer([&](Client& client) {
    ASSERT_TRUE(client.Import(ImportRequests("robot", nssm::WriteModelFile(TinyBundle(0)), 500)).ok());
    ++confirmed;
  });
  base::Rng rng(2026);
  for (int round = 0; round < kRounds && !HasFailure(); ++round) {
    SCOPED_TRACE(round);
    confirmed += KillAfter(1 + rng.Index(kUploadChanges), [seed = 0](Client& client) mutable {
      return client.Import(ImportRequests("robot", nssm::WriteModelFile(TinyBundle(++seed)), 500)).ok();
    });
    WithServer([&](Client& survivor) {
      CheckEverything(survivor);
      // What was confirmed is there; of the one under way it may not have been told.
      const auto model = survivor.Call(Named<v1::GetModelRequest>("models/robot"));
      EXPECT_GE(static_cast<int>(model.value.version_count()), confirmed);
      EXPECT_LE(static_cast<int>(model.value.version_count()), confirmed + round + 1);
    });
  }
  EXPECT_GT(confirmed, kRounds / 2);
}

TEST_F(KillTest, NothingHalfMadeIsListedAfterKillsDuringAdaptations) {
  std::vector<v1::AdaptRequest> requests(2);
  requests[0].mutable_options()->set_model("models/robot");
  *requests[1].mutable_samples() = TinyContext(60);
  int confirmed = 0;
  WithServer([&](Client& client) {
    ASSERT_TRUE(client.Import(ImportRequests("robot", nssm::WriteModelFile(TinyBundle()))).ok());
    ASSERT_TRUE(client.Adapt(requests).ok());
    ++confirmed;
  });
  base::Rng rng(2027);
  for (int round = 0; round < kRounds && !HasFailure(); ++round) {
    SCOPED_TRACE(round);
    confirmed += KillAfter(1 + rng.Index(kAdaptationChanges), [&](Client& client) { return client.Adapt(requests).ok(); });
    WithServer([&](Client& survivor) {
      CheckEverything(survivor);
      v1::ListAdaptationsRequest list;
      list.set_page_size(1000);
      const int listed = survivor.Call(list).value.adaptations_size();
      EXPECT_GE(listed, confirmed);
      EXPECT_LE(listed, confirmed + round + 1);
    });
  }
  EXPECT_GT(confirmed, kRounds / 2);
}

}  // namespace
}  // namespace metaekf::server
