// Workers and servers that die while they train: the job goes on, and its result is the same.

#include <unistd.h>

#include <filesystem>
#include <thread>

#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"
#include "tests/server/support/workers.h"

namespace metaekf::server {
namespace {

using ::testing::HasSubstr;

constexpr uint32_t kIterations = 1500;

class ResumeTest : public ServerTest {
 protected:
  v1::WatchJobResponse WatchToTheEnd(const std::string& job) {
    const auto watched = client_->Watch(job);
    EXPECT_TRUE(watched.ok()) << watched;
    return watched.value.empty() ? v1::WatchJobResponse() : watched.value.back();
  }
  std::string Digest(const std::string& version) {
    return client_->Call(Named<v1::GetModelVersionRequest>(version)).value.sha256();
  }
  /// Waits until a worker has written its first checkpoint.
  void AwaitCheckpoint(int64_t job) {
    const std::string path = directory_.path() + "/jobs/default-" + std::to_string(job) + "/checkpoint";
    while (!std::filesystem::exists(path)) std::this_thread::yield();
  }
};

TEST_F(ResumeTest, AKilledWorkersJobGoesOnToTheSameBits) {
  ASSERT_TRUE(client_->CreateJob(TinyJob("undisturbed", kIterations)).ok());
  ASSERT_EQ(WatchToTheEnd("jobs/1").state(), v1::Job::SUCCEEDED);

  ASSERT_TRUE(client_->CreateJob(TinyJob("killed", kIterations)).ok());
  AwaitCheckpoint(2);
  ASSERT_GT(WorkerOf(getpid()), 0);
  ASSERT_EQ(kill(WorkerOf(getpid()), SIGKILL), 0);
  bool reported = false;
  const auto watched = client_->Watch("jobs/2", [&](const v1::WatchJobResponse& response) {
    reported = reported || response.error_message().find("killed by signal 9") != std::string::npos;
    return true;
  });
  EXPECT_EQ(watched.value.back().state(), v1::Job::SUCCEEDED);
  EXPECT_TRUE(reported);
  EXPECT_EQ(client_->Call(Named<v1::GetJobRequest>("jobs/2")).value.attempt(), 2u);
  EXPECT_EQ(Digest("models/killed"), Digest("models/undisturbed"));
}

TEST_F(ResumeTest, AStoppedServersJobGoesOnToTheSameBits) {
  ASSERT_TRUE(client_->CreateJob(TinyJob("undisturbed", kIterations)).ok());
  ASSERT_EQ(WatchToTheEnd("jobs/1").state(), v1::Job::SUCCEEDED);

  ASSERT_TRUE(client_->CreateJob(TinyJob("stopped", kIterations)).ok());
  AwaitCheckpoint(2);
  Stop();
  EXPECT_EQ(WorkerOf(getpid()), 0);
  Start();
  EXPECT_EQ(WatchToTheEnd("jobs/2").state(), v1::Job::SUCCEEDED);
  const v1::Job job = client_->Call(Named<v1::GetJobRequest>("jobs/2")).value;
  EXPECT_EQ(job.attempt(), 2u);
  EXPECT_EQ(job.error_message(), "");  // a stop is no loss
  EXPECT_EQ(Digest("models/stopped"), Digest("models/undisturbed"));
}

TEST_F(ResumeTest, ADamagedCheckpointIsPassedOver) {
  ASSERT_TRUE(client_->CreateJob(TinyJob("undisturbed", kIterations)).ok());
  ASSERT_EQ(WatchToTheEnd("jobs/1").state(), v1::Job::SUCCEEDED);
  ASSERT_TRUE(client_->CreateJob(TinyJob("damaged", kIterations)).ok());
  AwaitCheckpoint(2);
  Stop();
  std::ofstream(directory_.path() + "/jobs/default-2/checkpoint") << "no checkpoint";
  Start();
  EXPECT_EQ(WatchToTheEnd("jobs/2").state(), v1::Job::SUCCEEDED);
  EXPECT_EQ(Digest("models/damaged"), Digest("models/undisturbed"));
}

TEST_F(ResumeTest, AJobWhoseWorkersDieAtOnceIsGivenUp) {
  Stop();
  options_.training.worker_binary = "/bin/false";
  Start();
  ASSERT_TRUE(client_->CreateJob(TinyJob("robot", 10)).ok());
  const v1::WatchJobResponse last = WatchToTheEnd("jobs/1");
  EXPECT_EQ(last.state(), v1::Job::FAILED);
  EXPECT_THAT(last.error_message(), HasSubstr("given up after 3 attempts"));
}

}  // namespace
}  // namespace metaekf::server
