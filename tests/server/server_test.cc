#include "server/server.h"

#include <thread>

#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

class RunningServerTest : public ServerTest {};

TEST_F(RunningServerTest, HealthAndReflectionAnswer) {
  EXPECT_EQ(client_->Health(), "SERVING");
  const std::string services = client_->ReflectedServices();
  for (const char* name : {"ModelService", "TrainingService", "AdaptationService",
                           "PredictionService", "SmoothingService", "EstimationService", "ServerService"}) {
    EXPECT_THAT(services, HasSubstr(std::string("metaekf.v1.") + name));
  }
}

TEST_F(RunningServerTest, TheServerTellsWhatItHolds) {
  Import("robot", TinyBundle());
  v1::GetServerInfoRequest request;
  request.set_verify_files(true);
  const auto info = client_->Call(request);
  ASSERT_TRUE(info.ok()) << info;
  EXPECT_THAT(info.value.version(), HasSubstr("."));
  EXPECT_EQ(info.value.data_directory().model_count(), 1u);
  EXPECT_EQ(info.value.data_directory().model_version_count(), 1u);
  EXPECT_GT(info.value.data_directory().free_disk_bytes(), 0u);
  EXPECT_EQ(info.value.data_directory().problems_size(), 0);
}

TEST_F(RunningServerTest, ADamagedFileIsReportedByName) {
  const std::string digest = Import("robot", TinyBundle()).sha256();
  const std::string path = directory_.path() + "/blobs/" + digest;
  std::fstream file(path, std::ios::in | std::ios::out);
  file.seekp(200);
  file.put('\x7f');
  file.close();
  v1::GetServerInfoRequest request;
  request.set_verify_files(true);
  const auto info = client_->Call(request);
  ASSERT_EQ(info.value.data_directory().problems_size(), 1);
  EXPECT_THAT(info.value.data_directory().problems(0), HasSubstr("robot"));

  const auto exported = client_->Call(Named<v1::ExportModelVersionRequest>("models/robot"));
  ExpectError(exported, absl::StatusCode::kDataLoss);
  EXPECT_THAT(exported.message, HasSubstr("robot"));
  EXPECT_THAT(exported.message, Not(HasSubstr(directory_.path())));  // nothing internal gets out
}

TEST_F(RunningServerTest, WhatItHoldsIsThereAfterARestart) {
  const v1::ModelVersion before = Import("robot", TinyBundle());
  Stop();
  Start();
  const auto after = client_->Call(Named<v1::GetModelVersionRequest>("models/robot"));
  EXPECT_EQ(after.value.SerializeAsString(), before.SerializeAsString());
}

TEST_F(RunningServerTest, ADrainedServerIsGone) {
  server_->Drain(absl::Seconds(5));
  server_->Drain(absl::Seconds(5));  // changes nothing
  EXPECT_EQ(client_->Health(), "UNAVAILABLE");
}

TEST_F(RunningServerTest, ASecondServerOnTheDirectoryOrThePortIsRefused) {
  const auto locked = Server::Start(options_);
  EXPECT_EQ(locked.status().code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_THAT(std::string(locked.status().message()), HasSubstr("in use by another server"));

  store::TempDirectory other;
  ServerOptions options = options_;
  options.data_directory = other.path();
  options.listen = server_->address();
  const auto busy = Server::Start(options);
  EXPECT_EQ(busy.status().code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_THAT(std::string(busy.status().message()), HasSubstr("--listen"));
}

TEST(ServerStartTest, AddressesAreChecked) {
  store::TempDirectory directory;
  ServerOptions options;
  options.data_directory = directory.path();
  for (const char* address : {"localhost", "localhost:", ":1", "localhost:70000", "localhost:a"}) {
    options.listen = address;
    EXPECT_EQ(Server::Start(options).status().code(), absl::StatusCode::kInvalidArgument)
        << address;
  }
  options.listen = "0.0.0.0:0";
  const auto exposed = Server::Start(options);
  EXPECT_EQ(exposed.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(exposed.status().message()), HasSubstr("--insecure"));
  options.insecure = true;
  EXPECT_TRUE(Server::Start(options).ok());
}

TEST(ServerStartTest, ADirectoryThatCannotBeMadeIsAnError) {
  ServerOptions options;
  options.data_directory = "/proc/metaekf";
  options.listen = "127.0.0.1:0";
  EXPECT_FALSE(Server::Start(options).ok());
}

}  // namespace
}  // namespace metaekf::server
