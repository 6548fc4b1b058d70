#include "metaekf/client.h"

#include <fcntl.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cmath>
#include <thread>

#include "google/rpc/error_details.pb.h"
#include "tests/client/fake_server.h"

namespace metaekf::client {
namespace {

using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::NanSensitiveDoubleEq;

const double kNaN = std::nan("");

class ClientTest : public ::testing::Test {
 protected:
  metaekf::testing::FakeServer server_;
  Client client_{{.server = server_.address()}};
};

TEST(ClientWithoutServerTest, SaysWhereNoServerIs) {
  // A port that was free a moment ago.
  std::string address;
  {
    metaekf::testing::FakeServer server;
    address = server.address();
  }
  Client client({.server = address});
  const Status status = client.ListModels().status();
  EXPECT_EQ(status.code, Code::kUnavailable);
  EXPECT_EQ(status.reason, "NO_SERVER");
  EXPECT_EQ(status.message, "no server at " + address);
}

TEST_F(ClientTest, TriesAConnectionThatFailsASecondTime) {
  const int listener = socket(AF_INET, SOCK_STREAM, 0);
  sockaddr_in address{.sin_family = AF_INET};
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  socklen_t size = sizeof(address);
  ASSERT_EQ(bind(listener, reinterpret_cast<const sockaddr*>(&address), size), 0);
  ASSERT_EQ(listen(listener, 2), 0);
  ASSERT_EQ(getsockname(listener, reinterpret_cast<sockaddr*>(&address), &size), 0);
  std::thread network([&] {
    close(accept(listener, nullptr, nullptr));
    const int connection = accept(listener, nullptr, nullptr);
    if (connection < 0) return;  // there was no second attempt
    EXPECT_EQ(fcntl(connection, F_SETFL, O_NONBLOCK), 0);
    server_.Serve(connection);
  });
  Client client({.server = "127.0.0.1:" + std::to_string(ntohs(address.sin_port))});
  const auto models = client.ListModels();
  EXPECT_TRUE(models.ok()) << models.status().message;
  shutdown(listener, SHUT_RDWR);  // wakes a thread that waits in vain
  network.join();
  close(listener);
}

TEST_F(ClientTest, ReadsWhatTheServerSaysOfItself) {
  server_.info.info.mutable_data_directory()->add_problems("a file is missing");
  const auto info = client_.GetServerInfo();
  ASSERT_TRUE(info.ok()) << info.status().message;
  EXPECT_EQ(info->version, "0.1.0");
  EXPECT_EQ(info->models, 1U);
  EXPECT_THAT(info->problems, ElementsAre("a file is missing"));
}

TEST_F(ClientTest, ListsModelsOfAllPages) {
  const auto models = client_.ListModels();
  ASSERT_TRUE(models.ok()) << models.status().message;
  ASSERT_EQ(models->size(), 2U);  // the server has one per page
  EXPECT_EQ((*models)[0].name, "vdp");
  EXPECT_EQ((*models)[0].aliases[0].alias, "stable");
  EXPECT_EQ((*models)[1].name, "second");
}

TEST_F(ClientTest, AsksForTheVersionThatIsMeant) {
  const auto version = client_.GetModelVersion("vdp@stable");
  ASSERT_TRUE(version.ok());
  EXPECT_EQ(server_.models.asked_version, "models/vdp/aliases/stable");
  EXPECT_EQ(version->version, 2U);
  EXPECT_FALSE(version->estimates_states);
  EXPECT_EQ(version->channels.outputs[0].unit, "m");
  EXPECT_FALSE(version->validation_loss.has_value());
  EXPECT_EQ(client_.GetModelVersion("nope").status().code, Code::kNotFound);
}

TEST_F(ClientTest, AModelFileComesBackAsItWent) {
  std::string file(1'300'000, '\0');  // three chunks
  for (size_t i = 0; i < file.size(); ++i) file[i] = static_cast<char>(i * 7);
  ASSERT_TRUE(client_.ImportModel("vdp", file).ok());
  EXPECT_EQ(server_.models.import_header.parent(), "models/vdp");
  EXPECT_EQ(server_.models.file, file);
  const auto again = client_.ExportModel("vdp");
  ASSERT_TRUE(again.ok()) << again.status().message;
  EXPECT_EQ(*again, file);

  server_.models.file[5] ^= 1;
  EXPECT_EQ(client_.ExportModel("vdp").status().code, Code::kDataLoss);
}

TEST_F(ClientTest, ImportSendsTheDigestOfTheFile) {
  ASSERT_TRUE(client_.ImportModel("vdp", "abc").ok());
  // SHA-256 of "abc", FIPS 180-2, appendix B.1.
  EXPECT_EQ(server_.models.import_header.sha256(),
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
}

TEST_F(ClientTest, SetsAndDeletesAliasesAndVersions) {
  ASSERT_TRUE(client_.SetModelAlias("vdp", "best", 2).ok());
  EXPECT_EQ(server_.models.set_alias.name(), "models/vdp/aliases/best");
  EXPECT_EQ(server_.models.set_alias.version(), 2U);
  EXPECT_EQ(client_.SetModelAlias("vdp", "3", 2).code, Code::kInvalidArgument);
  ASSERT_TRUE(client_.DeleteModelAlias("vdp@best").ok());
  EXPECT_EQ(server_.models.deleted, "models/vdp/aliases/best");
  ASSERT_TRUE(client_.DeleteModelVersion("vdp@2").ok());
  EXPECT_EQ(server_.models.deleted, "models/vdp/versions/2");
}

TEST_F(ClientTest, ALongTrajectoryIsSentInPieces) {
  // Two columns: 65,536 doubles per message are 32,768 samples.
  Trajectory trajectory{.name = "a", .samples = 40'000};
  trajectory.inputs.resize(40'000, 1);
  for (int i = 0; i < 40'000; ++i) trajectory.outputs.push_back(i);
  const auto job = client_.CreateTrainingJob({.model = "vdp",
                                              .spec = "iterations: 5",
                                              .channels = {.inputs = {{"u1", "N"}}},
                                              .fleet = {trajectory, trajectory}});
  ASSERT_TRUE(job.ok()) << job.status().message;
  EXPECT_EQ(job->id, "7");
  EXPECT_EQ(server_.training.header.spec().iterations(), 5U);
  EXPECT_EQ(server_.training.header.channels().inputs(0).unit(), "N");
  ASSERT_EQ(server_.training.messages.size(), 4U);
  EXPECT_EQ(server_.training.messages[1].sample_count(), 40'000U - 32'768U);
  EXPECT_EQ(server_.training.messages[1].outputs(0), 32'768);
}

TEST_F(ClientTest, RefusesSpecsAndTrajectoriesThatAreWrong) {
  EXPECT_THAT(client_.CreateTrainingJob({.model = "vdp", .spec = "x: 1", .spec_source = "f"})
                  .status()
                  .message,
              HasSubstr("f:1:"));
  const auto job = client_.CreateTrainingJob(
      {.model = "vdp", .fleet = {{.name = "a", .samples = 2, .outputs = {1, 2, 3}}}});
  EXPECT_EQ(job.status().code, Code::kInvalidArgument);
  EXPECT_THAT(job.status().message, AllOf(HasSubstr("\"a\""), HasSubstr("3 values")));
}

TEST_F(ClientTest, DetailsOfAnErrorArrive) {
  const auto bad = std::make_shared<google::rpc::BadRequest>();
  auto* violation = bad->add_field_violations();
  violation->set_field("header.spec.model.case");
  violation->set_description("say which");
  server_.training.refusal_code = static_cast<int>(Code::kInvalidArgument);
  server_.training.refusal_message = "wrong";
  server_.training.refusal_detail = bad;
  const Status status = client_.CreateTrainingJob({.model = "vdp"}).status();
  EXPECT_EQ(status.code, Code::kInvalidArgument);
  EXPECT_EQ(status.message, "wrong");
  ASSERT_EQ(status.violations.size(), 1U);
  EXPECT_EQ(status.violations[0].field, "header.spec.model.case");

  const auto retry = std::make_shared<google::rpc::RetryInfo>();
  retry->mutable_retry_delay()->set_nanos(500'000'000);
  server_.training.refusal_detail = retry;
  EXPECT_EQ(client_.CreateTrainingJob({.model = "vdp"}).status().retry_delay_s, 0.5);
}

TEST_F(ClientTest, FollowsAJobToItsEnd) {
  std::vector<uint32_t> iterations;
  const auto job = client_.WatchJob("7", [&](const Job& now) {
    iterations.push_back(now.progress->iteration);
    return true;
  });
  ASSERT_TRUE(job.ok()) << job.status().message;
  EXPECT_THAT(iterations, ElementsAre(1, 2, 3));
  EXPECT_EQ(job->state, JobState::kSucceeded);
  EXPECT_EQ(job->model_version, 3U);
  EXPECT_TRUE(job->ended());
}

TEST_F(ClientTest, StopsFollowingWhenTold) {
  int calls = 0;
  const auto job = client_.WatchJob("7", [&](const Job&) { return ++calls < 2; });
  ASSERT_TRUE(job.ok()) << job.status().message;
  EXPECT_EQ(calls, 2);
}

TEST_F(ClientTest, AdaptsAndReportsEveryStep) {
  std::vector<double> losses;
  AdaptationRequest request{.model = "vdp@1", .adaptation_id = "new"};
  request.method = AdaptationMethod::kAdam;
  request.inner_loop.learning_rate = 0.5;
  request.context = {.samples = 4, .inputs = {1, 2, 3, 4}, .outputs = {5, 6, 7, 8}};
  const auto adaptation = client_.Adapt(request, [&](const AdaptationProgress& progress) {
    losses.push_back(progress.loss);
    return true;
  });
  ASSERT_TRUE(adaptation.ok()) << adaptation.status().message;
  EXPECT_THAT(losses, ElementsAre(1, 0.5));
  EXPECT_EQ(server_.adaptations.options.model(), "models/vdp/versions/1");
  EXPECT_FALSE(server_.adaptations.options.inner_loop().has_steps());
  EXPECT_EQ(adaptation->id, "new");
  EXPECT_EQ(adaptation->model_version, 2U);
  EXPECT_EQ(adaptation->method, AdaptationMethod::kAdam);
  EXPECT_EQ(adaptation->inner_loop.learning_rate, 0.5);
  EXPECT_EQ(adaptation->context_samples, 4U);
  EXPECT_THAT(adaptation->held_out->arx.simulate, ElementsAre(0.5));
}

TEST_F(ClientTest, AShortContextIsRefusedWithTheSamplesNeeded) {
  const auto adaptation =
      client_.Adapt({.model = "vdp", .context = {.samples = 1, .outputs = {5}}});
  EXPECT_EQ(adaptation.status().code, Code::kFailedPrecondition);
  EXPECT_THAT(adaptation.status().message, HasSubstr("needs 4"));
}

TEST_F(ClientTest, PredictsEveryTrajectoryInOrder) {
  uint64_t answered = 0;
  const auto predictions =
      client_.Predict({.target = {.adaptation = "new"},
                       .trajectories = {{.name = "a", .samples = 3, .outputs = {1, 2, 4}},
                                        {.name = "b", .samples = 2, .outputs = {8, 9}}}},
                      [&](uint64_t samples) { answered = samples; });
  ASSERT_TRUE(predictions.ok()) << predictions.status().message;
  EXPECT_EQ(server_.predictions.header.target(), "adaptations/new");
  EXPECT_EQ(answered, 5U);
  ASSERT_EQ(predictions->size(), 2U);
  // The fake predicts the output before.
  EXPECT_THAT((*predictions)[0].outputs, ElementsAre(NanSensitiveDoubleEq(kNaN), 1, 2));
  EXPECT_THAT((*predictions)[1].outputs, ElementsAre(NanSensitiveDoubleEq(kNaN), 8));
  EXPECT_EQ((*predictions)[1].warmup_samples, 1U);
}

TEST_F(ClientTest, AServerThatGoesAwayIsSaidToBeLost) {
  ASSERT_TRUE(client_.ListModels().ok());
  server_.Stop();
  EXPECT_EQ(client_.ListModels().status().code, Code::kUnavailable);
}

TEST(ParseNoiseSettingsTest, ReadsAllFour) {
  const auto noise = ParseNoiseSettings(
      "process_noise_cov: [1, 2] measurement_noise_cov: 3 initial_mean: 4 initial_cov: 5", "n");
  ASSERT_TRUE(noise.ok()) << noise.status().message;
  EXPECT_THAT(noise->process_noise_cov, ElementsAre(1, 2));
  EXPECT_THAT(noise->measurement_noise_cov, ElementsAre(3));
  EXPECT_THAT(noise->initial_mean, ElementsAre(4));
  EXPECT_THAT(noise->initial_cov, ElementsAre(5));
  EXPECT_THAT(ParseNoiseSettings("Q: 1", "n").status().message, HasSubstr("n:1:"));
}

}  // namespace
}  // namespace metaekf::client
