// kill -9 of the server at seeded moments of training, adaptation and upload: it starts again,
// every model listed loads, nothing half made is listed, and the job goes on. A moment is a number of changes in the data
// directory: kills hit where something is being written, and a slow machine gets as far as a quick one.

#include <functional>
#include <thread>

#include "core/base/rng.h"
#include "tests/server/support/directory_changes.h"
#include "tests/server/support/server_process.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

using ::testing::IsEmpty;
using ::testing::SizeIs;

constexpr int kRounds = 20;
// Changes within which a kill comes: several uploads, adaptations or checkpoints.
constexpr uint64_t kUploadChanges = 60, kAdaptationChanges = 80, kTrainingChanges = 30;

class KillTest : public testing::Test {
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
    EXPECT_THAT(*store::ListDirectory(directory_.path() + "/tmp"), IsEmpty());
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
              testing::UnitTest::GetInstance()->current_test_info()->name() + ".textproto";
    std::ofstream(config_) << "training { threads_per_job: 1 checkpoint_period_s: 0.02 }";
  }
  void TearDown() override { std::remove(config_.c_str()); }

  store::TempDirectory directory_;
  std::string config_;
};

TEST_F(KillTest, TrainingGoesOnAfterEachOfTwentyKills) {
  WithServer([](Client& client) { ASSERT_TRUE(client.CreateJob(TinyJob("robot", 100'000'000)).ok()); });
  base::Rng rng(2025);
  for (int round = 0; round < kRounds && !HasFailure(); ++round) {
    SCOPED_TRACE(round);
    ServerProcess server = ServerProcess::Metaekfd(directory_.path(), config_);
    ASSERT_NE(server.address(), "") << "the server did not start";
    Client client(server.address());
    CheckEverything(client);
    EXPECT_TRUE(DirectoryChanges(directory_.path()).Wait(1 + rng.Index(kTrainingChanges)));
    EXPECT_EQ(server.End(SIGKILL).signal, SIGKILL);
  }
  // It is still the first job, further on than any server left it in the meantime.
  ServerProcess server = ServerProcess::Metaekfd(directory_.path(), config_);
  Client client(server.address());
  const auto jobs = client.Call(v1::ListJobsRequest());
  ASSERT_THAT(jobs.value.jobs(), SizeIs(1));
  const uint32_t reached = jobs.value.jobs(0).progress().iteration();
  const auto watched = client.Watch("jobs/1", [&](const v1::WatchJobResponse& response) {
    return response.progress().iteration() <= reached || response.state() != v1::Job::RUNNING;
  });
  EXPECT_EQ(watched.value.back().state(), v1::Job::RUNNING) << watched.value.back().error_message();
  EXPECT_GT(watched.value.back().progress().iteration(), reached);
  EXPECT_EQ(server.End(SIGTERM).code, 0);
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
