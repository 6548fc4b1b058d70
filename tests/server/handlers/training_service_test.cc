#include <cmath>
#include <functional>
#include <thread>

#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::SizeIs;

constexpr auto kInvalid = absl::StatusCode::kInvalidArgument;

class TrainingServiceTest : public ServerTest {};

TEST_F(TrainingServiceTest, AJobPublishesAVersionOfItsModel) {
  const auto created = client_->CreateJob(TinyJob("robot", 30));
  ASSERT_TRUE(created.ok()) << created;
  EXPECT_EQ(created.value.name(), "jobs/1");
  EXPECT_EQ(created.value.model(), "models/robot");
  EXPECT_EQ(created.value.spec().iterations(), 30u);

  const auto watched = client_->Watch("jobs/1");
  ASSERT_TRUE(watched.ok()) << watched;
  const v1::WatchJobResponse& last = watched.value.back();
  ASSERT_EQ(last.state(), v1::Job::SUCCEEDED) << last.error_message();
  EXPECT_EQ(last.model_version(), "models/robot/versions/1");
  EXPECT_EQ(last.progress().iteration(), 30u);
  EXPECT_EQ(last.progress().iterations(), 30u);
  EXPECT_TRUE(last.progress().has_best_validation_loss());

  const auto job = client_->Call(Named<v1::GetJobRequest>("jobs/1")).value;
  EXPECT_EQ(job.state(), v1::Job::SUCCEEDED);
  EXPECT_EQ(job.attempt(), 1u);
  EXPECT_TRUE(job.has_end_time());

  const auto version = client_->Call(Named<v1::GetModelVersionRequest>("models/robot")).value;
  EXPECT_EQ(version.training_job(), "jobs/1");
  EXPECT_EQ(version.validation_loss(), last.progress().best_validation_loss());
  EXPECT_EQ(version.spec().model().window(), 3u);
  // The work directory and the data have served their purpose.
  EXPECT_THAT(*store::ListDirectory(directory_.path() + "/jobs"), SizeIs(0));
}

TEST_F(TrainingServiceTest, ATrainingThatFailsSaysWhy) {
  auto requests = TinyJob("robot", 30);
  // Inner steps of this length blow any model up.
  requests[0].mutable_header()->mutable_spec()->mutable_inner_loop()->set_learning_rate(1e5);
  ASSERT_TRUE(client_->CreateJob(requests).ok());
  const auto watched = client_->Watch("jobs/1");
  ASSERT_TRUE(watched.ok()) << watched;
  EXPECT_EQ(watched.value.back().state(), v1::Job::FAILED);
  EXPECT_THAT(watched.value.back().error_message(), HasSubstr("diverged at iteration 1: loss"));
  EXPECT_EQ(watched.value.back().model_version(), "");
  // The last good state stays, also over a restart.
  EXPECT_THAT(*store::ListDirectory(directory_.path() + "/jobs/default-1"), ElementsAre("checkpoint"));
  Stop();
  Start();
  EXPECT_THAT(*store::ListDirectory(directory_.path() + "/jobs/default-1"), ElementsAre("checkpoint"));
}

TEST_F(TrainingServiceTest, ACancelledJobStopsForGood) {
  ASSERT_TRUE(client_->CreateJob(TinyJob("robot", 100'000'000)).ok());
  const auto watched = client_->Watch("jobs/1", [&](const v1::WatchJobResponse& response) {
    if (response.progress().iteration() > 0) {
      EXPECT_TRUE(client_->Call(Named<v1::CancelJobRequest>("jobs/1")).ok());
    }
    return true;
  });
  ASSERT_TRUE(watched.ok()) << watched;
  EXPECT_EQ(watched.value.back().state(), v1::Job::CANCELLED);
  // Again changes nothing; the next job finds the worker's place free.
  EXPECT_EQ(client_->Call(Named<v1::CancelJobRequest>("jobs/1")).value.state(), v1::Job::CANCELLED);
  ASSERT_TRUE(client_->CreateJob(TinyJob("robot", 2)).ok());
  EXPECT_EQ(client_->Watch("jobs/2").value.back().state(), v1::Job::SUCCEEDED);
  EXPECT_THAT(*store::ListDirectory(directory_.path() + "/jobs"), SizeIs(0));
  ExpectError(client_->Call(Named<v1::CancelJobRequest>("jobs/2")),
              absl::StatusCode::kFailedPrecondition);
}

TEST_F(TrainingServiceTest, ARequestIdSentTwiceMakesOneJob) {
  auto requests = TinyJob("robot", 2);
  requests[0].mutable_header()->set_request_id("once");
  EXPECT_EQ(client_->CreateJob(requests).value.name(), "jobs/1");
  EXPECT_EQ(client_->CreateJob(requests).value.name(), "jobs/1");
  requests[1].mutable_samples()->set_outputs(5, 0.25);
  ExpectError(client_->CreateJob(requests), absl::StatusCode::kAlreadyExists);
}

TEST_F(TrainingServiceTest, JobsAreListedNewestFirst) {
  for (int i = 0; i < 3; ++i) ASSERT_TRUE(client_->CreateJob(TinyJob("robot", 1)).ok());
  v1::ListJobsRequest request;
  request.set_page_size(2);
  auto page = client_->Call(request);
  ASSERT_THAT(page.value.jobs(), SizeIs(2));
  EXPECT_EQ(page.value.jobs(0).name(), "jobs/3");
  request.set_page_token(page.value.next_page_token());
  page = client_->Call(request);
  ASSERT_THAT(page.value.jobs(), SizeIs(1));
  EXPECT_EQ(page.value.jobs(0).name(), "jobs/1");
}

TEST_F(TrainingServiceTest, WrongHeadersAreRefusedWithTheField) {
  using Header = v1::CreateTrainingJobRequest::Header;
  const auto expect = [&](const std::string& field, const std::function<void(Header&)>& spoil) {
    auto requests = TinyJob("robot", 2);
    spoil(*requests[0].mutable_header());
    SCOPED_TRACE(field);
    ExpectError(client_->CreateJob(requests), kInvalid, {field});
  };
  expect("header.model", [](Header& h) { h.set_model("robot"); });
  expect("header.spec.model.case",
         [](Header& h) { h.mutable_spec()->mutable_model()->clear_case_(); });
  expect("header.spec.model.latent_size",
         [](Header& h) { h.mutable_spec()->mutable_model()->set_latent_size(0); });
  expect("header.spec.model.input_size",
         [](Header& h) { h.mutable_spec()->mutable_model()->set_input_size(3); });
  expect("header.spec.outer_lr", [](Header& h) { h.mutable_spec()->set_outer_lr(std::nan("")); });
  expect("header.spec.inner_loop.adapted_mask",
         [](Header& h) { h.mutable_spec()->mutable_inner_loop()->set_adapted_mask("brain"); });
  expect("header.spec.adaptation.adapted_mask",
         [](Header& h) { h.mutable_spec()->mutable_adaptation()->set_adapted_mask("brain"); });
  expect("header.channels.outputs", [](Header& h) { h.mutable_channels()->clear_outputs(); });
  expect("header.channels.outputs[0].name",
         [](Header& h) { h.mutable_channels()->mutable_outputs(0)->set_name("u1"); });
  expect("header.channels.states", [](Header& h) {
    h.mutable_spec()->mutable_model()->set_case_(v1::ModelSpec::STATE_INPUT_OUTPUT);
  });
}

TEST_F(TrainingServiceTest, WrongFleetsAreRefusedWithTheirPlace) {
  const auto submit =
      [&](const std::function<void(std::vector<v1::CreateTrainingJobRequest>&)>& spoil) {
        auto requests = TinyJob("robot", 2);
        spoil(requests);
        return client_->CreateJob(requests);
      };
  auto reply = submit([](auto& r) { r[2].mutable_samples()->set_outputs(5, std::nan("")); });
  ExpectError(reply, kInvalid, {"samples.outputs[5]"});
  EXPECT_THAT(reply.message, HasSubstr("trajectory 'system 1', sample 5: output 1 is nan"));
  reply = submit([](auto& r) { r[2].mutable_samples()->mutable_inputs()->RemoveLast(); });
  ExpectError(reply, kInvalid, {"samples.inputs"});
  reply = submit([](auto& r) { r[2].mutable_samples()->set_sample_period_s(0.2); });
  ExpectError(reply, kInvalid, {"samples.sample_period_s"});
  reply = submit([](auto& r) { r.push_back(r[1]); });
  ExpectError(reply, kInvalid, {"samples.trajectory"});
  reply = submit([](auto& r) { r.resize(1); });
  ExpectError(reply, kInvalid, {"samples"});
  reply = submit([](auto& r) { r.resize(2); });
  ExpectError(reply, kInvalid, {"header.spec.validation_share"});
  reply = submit([](auto& r) { r.erase(r.begin()); });
  ExpectError(reply, kInvalid, {"header"});
  reply = submit([](auto& r) { r.push_back(r[0]); });
  ExpectError(reply, kInvalid, {"samples"});
  reply = submit([](auto& r) {
    for (size_t i = 1; i < r.size(); ++i) r[i].mutable_samples()->set_sample_period_s(0);
  });
  ExpectError(reply, kInvalid, {"header.spec.sample_period_s"});
  reply = submit([](auto& r) { r[0].mutable_header()->mutable_spec()->set_context_samples(61); });
  ExpectError(reply, absl::StatusCode::kFailedPrecondition);
  EXPECT_THAT(reply.message, HasSubstr("61"));
  EXPECT_THAT(client_->Call(v1::ListJobsRequest()).value.jobs(), SizeIs(0));
}

TEST_F(TrainingServiceTest, HalfAnUploadMakesNoJob) {
  EXPECT_EQ(client_->CreateJobAndCancel(TinyJob("robot", 2)).code, absl::StatusCode::kCancelled);
  ASSERT_TRUE(client_->CreateJob(TinyJob("other", 1)).ok());
  const auto jobs = client_->Call(v1::ListJobsRequest()).value;
  ASSERT_THAT(jobs.jobs(), SizeIs(1));
  EXPECT_EQ(jobs.jobs(0).model(), "models/other");
}

TEST_F(TrainingServiceTest, UnknownAndMisspeltJobsAreToldApart) {
  ExpectError(client_->Call(Named<v1::GetJobRequest>("jobs/1")), absl::StatusCode::kNotFound);
  ExpectError(client_->Call(Named<v1::CancelJobRequest>("jobs/1")), absl::StatusCode::kNotFound);
  ExpectError(client_->Watch("jobs/1"), absl::StatusCode::kNotFound);
  ExpectError(client_->Call(Named<v1::GetJobRequest>("jobs/one")), kInvalid, {"name"});
  ExpectError(client_->Watch("job"), kInvalid, {"name"});
}

TEST_F(TrainingServiceTest, TooManyWaitingJobsAreRefused) {
  Stop();
  options_.training.max_queued_jobs = 1;
  Start();
  // One runs, one waits, the third is too many.
  ASSERT_TRUE(client_->CreateJob(TinyJob("robot", 100'000'000)).ok());
  client_->Watch("jobs/1", [](const auto& r) { return r.state() != v1::Job::RUNNING; });
  ASSERT_TRUE(client_->CreateJob(TinyJob("robot", 1)).ok());
  ExpectError(client_->CreateJob(TinyJob("robot", 1)), absl::StatusCode::kResourceExhausted);
}

TEST_F(TrainingServiceTest, AStoppedServerTellsWatchersAndItsJobGoesOn) {
  ASSERT_TRUE(client_->CreateJob(TinyJob("robot", 400)).ok());
  bool stopping = false;
  std::thread stopper;
  const auto watched = client_->Watch("jobs/1", [&](const v1::WatchJobResponse& response) {
    if (!stopping && response.state() == v1::Job::RUNNING) {
      stopping = true;
      stopper = std::thread([this] { server_->Drain(absl::Seconds(5)); });
    }
    return true;
  });
  stopper.join();
  EXPECT_EQ(watched.code, absl::StatusCode::kUnavailable);
  Stop();
  Start();
  EXPECT_EQ(client_->Watch("jobs/1").value.back().state(), v1::Job::SUCCEEDED);
}

}  // namespace
}  // namespace metaekf::server
