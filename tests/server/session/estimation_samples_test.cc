// What samples may say, and what is estimated from them.

#include <functional>

#include "tests/server/session/estimation_test.h"

namespace metaekf::server {
namespace {

using EstimationSamplesTest = EstimationTest;

TEST_F(EstimationSamplesTest, AForecastThatNoClientCouldReceiveIsRefused) {
  Import("wide", TinyStateBundle(16));  // 1.2 KB per estimate
  Call call = Start(OpenRequest("models/wide"));
  ReadOpened(call);
  v1::EstimateRequest forecast;
  v1::EstimateResponse response;
  forecast.mutable_forecast()->set_horizon(3000);
  call.stream->Write(forecast);
  ASSERT_TRUE(call.stream->Read(&response)) << call.stream->Finish().error_message();
  EXPECT_EQ(response.forecast().nis_size(), 3000);
  forecast.mutable_forecast()->set_horizon(10'000);
  call.stream->Write(forecast);
  EXPECT_FALSE(call.stream->Read(&response));
  EXPECT_THAT(call.stream->Finish().error_message(), ::testing::HasSubstr("can be asked for at a time, got 10000"));
}

TEST_F(EstimationSamplesTest, BadSamplesEndTheStreamAndChangeNothing) {
  const Recording recording = MakeRecording(40, 0);
  Call call = Start(OpenRequest());
  const v1::SessionOpened opened = ReadOpened(call);
  Estimates estimates = Run(call, recording, 1, 20, 20);
  EXPECT_TRUE(End(call).ok());
  struct Bad {
    std::function<void(v1::SampleBatch*)> change;
    grpc::StatusCode code;
    std::string named;
  };
  const Bad cases[] = {
      {[](v1::SampleBatch* b) { b->set_inputs(2, kNaN); }, grpc::StatusCode::INVALID_ARGUMENT, "samples.inputs[2]"},
      {[](v1::SampleBatch* b) { b->set_outputs(1, HUGE_VAL); }, grpc::StatusCode::INVALID_ARGUMENT, "samples.outputs[1]"},
      {[](v1::SampleBatch* b) { b->add_inputs(0); }, grpc::StatusCode::INVALID_ARGUMENT, "samples.inputs"},
      {[](v1::SampleBatch* b) { b->add_times_s(0); }, grpc::StatusCode::INVALID_ARGUMENT, "samples.times_s"},
      {[](v1::SampleBatch* b) { for (int i = 0; i < 5; ++i) b->add_times_s(1 + 0.03 * i); }, grpc::StatusCode::INVALID_ARGUMENT, "samples.times_s"},
      {[](v1::SampleBatch* b) { b->set_first_seq(23); }, grpc::StatusCode::OUT_OF_RANGE, "expected 21"},
      {[](v1::SampleBatch* b) { b->set_first_seq(0); }, grpc::StatusCode::INVALID_ARGUMENT, "samples.first_seq"},
  };
  for (const Bad& bad : cases) {
    Call again = Start(ResumeRequest(opened));
    ReadOpened(again);
    v1::EstimateRequest request = Batch(recording, 21, 5);
    bad.change(request.mutable_samples());
    again.stream->Write(request);
    v1::EstimateResponse response;
    EXPECT_FALSE(again.stream->Read(&response)) << bad.named;
    const grpc::Status status = again.stream->Finish();
    EXPECT_EQ(status.error_code(), bad.code) << status.error_message();
    EXPECT_NE(status.error_message().find(bad.named), std::string::npos) << status.error_message();
  }
  Call last = Start(ResumeRequest(opened));
  ReadOpened(last);
  const Estimates rest = Run(last, recording, 21, 40, 5);
  estimates.insert(estimates.end(), rest.begin(), rest.end());
  ExpectIdentical(estimates, Direct(recording));
}

TEST_F(EstimationSamplesTest, AGapInTimeIsATimeUpdateForEachPeriod) {
  // The same as sending a sample without measurement for every period that is missing.
  Recording with_gaps = MakeRecording(30, 0);
  for (const size_t t : {size_t{10}, size_t{11}, size_t{20}}) {
    with_gaps.inputs[t] = with_gaps.inputs[t - 1];
    with_gaps.outputs[t] = kNaN;
  }
  const Estimates direct = Direct(with_gaps);
  const size_t row = direct.size() / 30;
  Call call = Start(OpenRequest());
  const double period = ReadOpened(call).sample_period_s();
  v1::EstimateRequest request;
  v1::SampleBatch* batch = request.mutable_samples();
  batch->set_first_seq(1);
  Estimates expected;
  for (size_t t = 0; t < 30; ++t) {
    if (t == 10 || t == 11 || t == 20) continue;
    batch->add_inputs(with_gaps.inputs[t]);
    batch->add_outputs(with_gaps.outputs[t]);
    batch->add_times_s(7 + period * static_cast<double>(t));
    expected.insert(expected.end(), direct.begin() + static_cast<long>(t * row), direct.begin() + static_cast<long>((t + 1) * row));
  }
  call.stream->Write(request);
  v1::EstimateResponse response;
  ASSERT_TRUE(call.stream->Read(&response));
  Estimates estimates;
  Append(response.estimates(), &estimates);
  ExpectIdentical(estimates, expected);
}

// Every third measurement comes two samples later: what is known after it is what a stream without delays knows at that time.
TEST_F(EstimationSamplesTest, LateMeasurementsGoToTheirOwnTimeAndSurviveAResume) {
  const Recording recording = MakeRecording(60, 0);
  const Estimates direct = Direct(recording);
  const size_t row = direct.size() / 60;
  const double period = bundle_->sample_period_s;
  v1::EstimateRequest open = OpenRequest();
  open.mutable_open()->set_max_lag_s(3 * period);
  Call call = Start(open);
  v1::SessionOpened opened = ReadOpened(call);
  uint64_t seq = 0;
  const auto send = [&](double periods, double input, double output) {
    v1::EstimateRequest request;
    v1::SampleBatch* batch = request.mutable_samples();
    batch->set_first_seq(++seq);
    batch->add_times_s(periods * period);
    batch->add_inputs(input);
    batch->add_outputs(output);
    call.stream->Write(request);
    v1::EstimateResponse response;
    EXPECT_TRUE(call.stream->Read(&response)) << call.stream->Finish().error_message();
    return response.estimates();
  };
  for (size_t t = 0; t < 60; ++t) {
    const bool late = t % 3 == 0 && t + 2 < 60;
    send(static_cast<double>(t), recording.inputs[t], late ? kNaN : recording.outputs[t]);
    if (t % 3 == 2) {
      const v1::EstimateBatch at = send(static_cast<double>(t - 2), 0, recording.outputs[t - 2]);
      EXPECT_EQ(at.flags(0), v1::EstimateBatch::DELAYED);
      EXPECT_EQ(at.times_s(0), static_cast<double>(t - 2) * period);
      Estimates estimates;
      Append(at, &estimates);
      ExpectIdentical(estimates, {direct.begin() + static_cast<long>((t - 2) * row), direct.begin() + static_cast<long>((t - 1) * row)});
    }
    if (t == 31) {  // a late measurement of sample 30 is still to come
      EXPECT_TRUE(End(call).ok());
      call = Start(ResumeRequest(opened));
      const std::string token = opened.token();
      opened = ReadOpened(call);
      opened.set_token(token);
      ASSERT_EQ(opened.durable_seq(), seq);
    }
  }
  Estimates last;
  Append(send(60, 0.5, kNaN), &last);
  EXPECT_FALSE(std::isnan(last[0]));
  // Later than the lag.
  v1::EstimateRequest request = Batch(recording, ++seq, 1);
  request.mutable_samples()->set_first_seq(seq);
  request.mutable_samples()->clear_inputs();
  request.mutable_samples()->clear_outputs();
  request.mutable_samples()->add_inputs(0);
  request.mutable_samples()->add_outputs(1);
  request.mutable_samples()->add_times_s(56 * period);
  call.stream->Write(request);
  v1::EstimateResponse response;
  EXPECT_FALSE(call.stream->Read(&response));
  const grpc::Status status = call.stream->Finish();
  EXPECT_EQ(status.error_code(), grpc::StatusCode::INVALID_ARGUMENT);
  EXPECT_NE(status.error_message().find("at most 3 sample periods late"), std::string::npos) << status.error_message();
}

TEST_F(EstimationSamplesTest, OutliersAreFlaggedAndBelievedWithoutAGate) {
  Recording recording = MakeRecording(50, 0);
  recording.outputs[40] += 1e6;
  for (const bool off : {false, true}) {
    v1::EstimateRequest open = OpenRequest();
    open.mutable_open()->mutable_gate()->set_off(off);
    Call call = Start(open);
    ReadOpened(call);
    call.stream->Write(Batch(recording, 1, 50));
    v1::EstimateResponse response;
    ASSERT_TRUE(call.stream->Read(&response));
    EXPECT_EQ(response.estimates().flags(40), off ? v1::EstimateBatch::NO_FLAG : v1::EstimateBatch::GATED);
    EXPECT_GT(response.estimates().nis(40), 1e6);
  }
}

TEST_F(EstimationSamplesTest, SamplesMayBringTheirOwnNoise) {
  const Recording recording = MakeRecording(20, 0);
  v1::EstimateRequest noisy = OpenRequest();
  noisy.mutable_open()->mutable_noise()->add_measurement_noise_cov(0.7);
  Call expected = Start(noisy), call = Start(OpenRequest());
  ReadOpened(expected);
  ReadOpened(call);
  v1::EstimateRequest request = Batch(recording, 1, 20);
  for (int t = 0; t < 20; ++t) request.mutable_samples()->add_measurement_noise_covs(0.7);
  call.stream->Write(request);
  v1::EstimateResponse response;
  ASSERT_TRUE(call.stream->Read(&response));
  Estimates estimates;
  Append(response.estimates(), &estimates);
  ExpectIdentical(estimates, Run(expected, recording, 1, 20, 20));

  request = Batch(recording, 21, 20);
  request.mutable_samples()->set_first_seq(21);
  request.mutable_samples()->add_inputs(0);
  request.mutable_samples()->add_outputs(0);
  request.mutable_samples()->add_measurement_noise_covs(-1);
  call.stream->Write(request);
  EXPECT_FALSE(call.stream->Read(&response));
  EXPECT_NE(call.stream->Finish().error_message().find("samples.measurement_noise_covs"), std::string::npos);
}

TEST_F(EstimationSamplesTest, ForecastsAreWhatPassesWithoutMeasurements) {
  Recording recording = MakeRecording(30, 0);
  Call call = Start(OpenRequest());
  ReadOpened(call);
  Run(call, recording, 1, 20, 20);
  v1::EstimateRequest request;
  request.mutable_forecast()->set_horizon(10);
  for (size_t t = 20; t < 30; ++t) request.mutable_forecast()->add_inputs(recording.inputs[t]);
  call.stream->Write(request);
  v1::EstimateResponse response;
  ASSERT_TRUE(call.stream->Read(&response)) << call.stream->Finish().error_message();
  ASSERT_TRUE(response.has_forecast());
  EXPECT_EQ(response.forecast().first_seq(), 21u);
  Estimates forecast;
  Append(response.forecast(), &forecast);
  // The session goes on as if nothing had been asked.
  for (size_t t = 20; t < 30; ++t) recording.outputs[t] = kNaN;
  ExpectIdentical(Run(call, recording, 21, 30, 10), forecast);

  request.mutable_forecast()->clear_inputs();
  request.mutable_forecast()->set_horizon(3);
  call.stream->Write(request);
  ASSERT_TRUE(call.stream->Read(&response));
  EXPECT_EQ(response.forecast().nis_size(), 3);
  request.mutable_forecast()->set_horizon(0);
  call.stream->Write(request);
  EXPECT_FALSE(call.stream->Read(&response));
  EXPECT_NE(call.stream->Finish().error_message().find("forecast.horizon"), std::string::npos);
}

}  // namespace
}  // namespace metaekf::server
