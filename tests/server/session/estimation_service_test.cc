#include <grpcpp/grpcpp.h>

#include <cmath>
#include <limits>
#include <thread>
#include <vector>

#include "core/base/rng.h"
#include "core/filter/ekf.h"
#include "metaekf/v1/estimation.grpc.pb.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

using Stream = grpc::ClientReaderWriter<v1::EstimateRequest, v1::EstimateResponse>;

/// A recording with missing values: one input, one output.
struct Recording {
  std::vector<double> inputs, outputs;
};

Recording MakeRecording(int samples, double missing_share) {
  base::Rng rng(4);
  Recording recording;
  double y = 0;
  for (int t = 0; t < samples; ++t) {
    const double u = rng.Normal();
    recording.inputs.push_back(u);
    recording.outputs.push_back(rng.Uniform() < missing_share ? kNaN : y + 0.01 * rng.Normal());
    y = 0.8 * y + 0.3 * u;
  }
  return recording;
}

/// All estimates of a session, one value after the other: mean, covariance and NIS of every sample.
using Estimates = std::vector<double>;

class EstimationServiceTest : public ServerTest {
 protected:
  void SetUp() override {
    ServerTest::SetUp();
    Connect();
    bundle_ = TinyStateBundle();
    Import("tiny", *bundle_);
  }

  void Connect() {
    stub_ = v1::EstimationService::NewStub(grpc::CreateChannel(server_->address(), grpc::InsecureChannelCredentials()));
  }

  /// A stream with its first request written.
  struct Call {
    std::unique_ptr<grpc::ClientContext> context = std::make_unique<grpc::ClientContext>();
    std::unique_ptr<Stream> stream;
  };

  Call Start(const v1::EstimateRequest& first) {
    Call call;
    call.context->set_deadline(std::chrono::system_clock::now() + std::chrono::minutes(1));
    call.stream = stub_->Estimate(call.context.get());
    call.stream->Write(first);
    return call;
  }

  static v1::EstimateRequest OpenRequest(const std::string& target = "models/tiny") {
    v1::EstimateRequest request;
    request.mutable_open()->set_target(target);
    request.mutable_open()->set_covariance_format(v1::OpenSession::LOWER_TRIANGLE);
    return request;
  }

  static v1::EstimateRequest ResumeRequest(const v1::SessionOpened& opened) {
    v1::EstimateRequest request;
    request.mutable_resume()->set_session(opened.session());
    request.mutable_resume()->set_token(opened.token());
    return request;
  }

  static v1::EstimateRequest Batch(const Recording& recording, uint64_t first_seq, size_t count) {
    v1::EstimateRequest request;
    v1::SampleBatch* batch = request.mutable_samples();
    batch->set_first_seq(first_seq);
    for (size_t t = first_seq - 1; t < std::min(first_seq - 1 + count, recording.inputs.size()); ++t) {
      batch->add_inputs(recording.inputs[t]);
      batch->add_outputs(recording.outputs[t]);
    }
    return request;
  }

  static v1::SessionOpened ReadOpened(Call& call) {
    v1::EstimateResponse response;
    EXPECT_TRUE(call.stream->Read(&response)) << call.stream->Finish().error_message();
    return response.opened();
  }

  static void Append(const v1::EstimateBatch& batch, Estimates* estimates) {
    const int rows = batch.nis_size();
    const int n = rows > 0 ? batch.means_size() / rows : 0, triangle = rows > 0 ? batch.covariances_size() / rows : 0;
    for (int row = 0; row < rows; ++row) {
      for (int i = 0; i < n; ++i) estimates->push_back(batch.means(row * n + i));
      for (int i = 0; i < triangle; ++i) estimates->push_back(batch.covariances(row * triangle + i));
      estimates->push_back(batch.nis(row));
    }
  }

  /// Sends samples first_seq … last and collects what comes back.
  static Estimates Run(Call& call, const Recording& recording, uint64_t first_seq, size_t last, size_t per_message) {
    Estimates estimates;
    v1::EstimateResponse response;
    for (uint64_t seq = first_seq; seq <= last; seq += per_message) {
      call.stream->Write(Batch(recording, seq, std::min(per_message, last - seq + 1)));
      EXPECT_TRUE(call.stream->Read(&response)) << call.stream->Finish().error_message();
      EXPECT_EQ(response.estimates().first_seq(), seq);
      Append(response.estimates(), &estimates);
    }
    return estimates;
  }

  static grpc::Status End(Call& call) {
    call.stream->WritesDone();
    v1::EstimateResponse response;
    while (call.stream->Read(&response)) continue;
    return call.stream->Finish();
  }

  /// What the filter says that is called directly.
  Estimates Direct(const Recording& recording) const {
    const std::shared_ptr<filter::FilterModel> model = filter::FilterModel::Create(*bundle_);
    filter::Ekf ekf = *filter::Ekf::Create(*bundle_, model, model->Prepare(bundle_->parameters), {});
    const auto scratch = model->MakeScratch();
    filter::Estimate estimate = ekf.MakeEstimate();
    Estimates estimates;
    for (size_t t = 0; t < recording.inputs.size(); ++t) {
      EXPECT_TRUE(ekf.Step(Eigen::VectorXd::Constant(1, recording.inputs[t]),
                           Eigen::VectorXd::Constant(1, recording.outputs[t]), scratch.get(), &estimate).ok());
      for (const double value : estimate.mean) estimates.push_back(value);
      for (Eigen::Index i = 0; i < estimate.cov.rows(); ++i) {
        for (Eigen::Index j = 0; j <= i; ++j) estimates.push_back(estimate.cov(i, j));
      }
      estimates.push_back(estimate.nis);
    }
    return estimates;
  }

  static void ExpectIdentical(const Estimates& a, const Estimates& b) {
    ASSERT_EQ(a.size(), b.size());
    for (size_t i = 0; i < a.size(); ++i) {
      ASSERT_TRUE(a[i] == b[i] || (std::isnan(a[i]) && std::isnan(b[i]))) << "value " << i << ": " << a[i] << ", " << b[i];
    }
  }

  std::optional<nssm::Bundle> bundle_;
  std::unique_ptr<v1::EstimationService::Stub> stub_;
};

TEST_F(EstimationServiceTest, TheStreamEqualsTheFilterBitForBit) {
  const Recording recording = MakeRecording(10000, 0.05);
  const Estimates direct = Direct(recording);
  for (const size_t per_message : {size_t{1}, size_t{64}, size_t{10000}}) {
    Call call = Start(OpenRequest());
    ReadOpened(call);
    ExpectIdentical(Run(call, recording, 1, 10000, per_message), direct);
    EXPECT_TRUE(End(call).ok());
  }
}

TEST_F(EstimationServiceTest, ALargeBatchIsAnsweredInPieces) {
  const Recording recording = MakeRecording(50'000, 0.05);
  Call call = Start(OpenRequest());
  const v1::SessionOpened opened = ReadOpened(call);
  call.stream->Write(Batch(recording, 1, 50'000));
  Estimates estimates;
  v1::EstimateResponse response;
  int pieces = 0;
  for (uint64_t next = 1; next <= 50'000; ++pieces) {
    ASSERT_TRUE(call.stream->Read(&response)) << call.stream->Finish().error_message();
    ASSERT_EQ(response.estimates().first_seq(), next);
    EXPECT_LT(response.ByteSizeLong(), size_t{1} << 20);
    Append(response.estimates(), &estimates);
    next += static_cast<uint64_t>(response.estimates().nis_size());
  }
  EXPECT_GT(pieces, 2);
  ExpectIdentical(estimates, Direct(recording));
  EXPECT_TRUE(End(call).ok());

  // Checked as a whole before any of it is applied.
  Call refused = Start(OpenRequest());
  ReadOpened(refused);
  v1::EstimateRequest wrong = Batch(recording, 1, 50'000);
  wrong.mutable_samples()->set_inputs(49'999, std::numeric_limits<double>::infinity());
  refused.stream->Write(wrong);
  EXPECT_FALSE(refused.stream->Read(&response));
  EXPECT_EQ(refused.stream->Finish().error_code(), grpc::StatusCode::INVALID_ARGUMENT);
}

TEST_F(EstimationServiceTest, AForecastThatNoClientCouldReceiveIsRefused) {
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

TEST_F(EstimationServiceTest, StreamsOfALargeModelAtTheSameTimeEqualTheFilterBitForBit) {
  bundle_ = LargeStateBundle();
  Import("large", *bundle_);
  const Recording recording = MakeRecording(400, 0.05);
  const Estimates direct = Direct(recording);
  std::vector<std::thread> clients;
  for (size_t client = 0; client < 10; ++client) {
    clients.emplace_back([&, client] {
      Call call = Start(OpenRequest("models/large"));
      ReadOpened(call);
      ExpectIdentical(Run(call, recording, 1, 400, client < 6 ? 1 : 7 * client), direct);
      EXPECT_TRUE(End(call).ok());
    });
  }
  for (std::thread& client : clients) client.join();
}

TEST_F(EstimationServiceTest, AResumedSessionGoesOnBitForBit) {
  const Recording recording = MakeRecording(300, 0.05);
  const Estimates direct = Direct(recording);
  Call call = Start(OpenRequest());
  const v1::SessionOpened opened = ReadOpened(call);
  EXPECT_EQ(opened.epoch(), 1u);
  EXPECT_EQ(opened.durable_seq(), 0u);
  Estimates estimates = Run(call, recording, 1, 120, 10);
  call.context->TryCancel();
  call.stream->Finish();

  Call resumed = Start(ResumeRequest(opened));
  const v1::SessionOpened again = ReadOpened(resumed);
  EXPECT_EQ(again.epoch(), 2u);
  EXPECT_EQ(again.durable_seq(), 120u);
  // Samples sent twice are applied once.
  resumed.stream->Write(Batch(recording, 101, 40));
  v1::EstimateResponse response;
  ASSERT_TRUE(resumed.stream->Read(&response));
  EXPECT_EQ(response.estimates().first_seq(), 121u);
  EXPECT_EQ(response.estimates().nis_size(), 20);
  Append(response.estimates(), &estimates);
  const Estimates rest = Run(resumed, recording, 141, 300, 7);
  estimates.insert(estimates.end(), rest.begin(), rest.end());
  ExpectIdentical(estimates, direct);
}

TEST_F(EstimationServiceTest, ARestartOfTheServerLosesNothing) {
  const Recording recording = MakeRecording(200, 0.05);
  Call call = Start(OpenRequest());
  const v1::SessionOpened opened = ReadOpened(call);
  Estimates estimates = Run(call, recording, 1, 100, 10);
  Stop();
  const grpc::Status drained = call.stream->Finish();
  EXPECT_EQ(drained.error_code(), grpc::StatusCode::UNAVAILABLE) << drained.error_message();
  ServerTest::Start();
  Connect();
  Call resumed = Start(ResumeRequest(opened));
  EXPECT_EQ(ReadOpened(resumed).durable_seq(), 100u);
  const Estimates rest = Run(resumed, recording, 101, 200, 10);
  estimates.insert(estimates.end(), rest.begin(), rest.end());
  ExpectIdentical(estimates, Direct(recording));
}

TEST_F(EstimationServiceTest, AClientThatTellsWhatHasArrivedGoesOnBehindIt) {
  const Recording recording = MakeRecording(20'000, 0);
  Call call = Start(OpenRequest());
  const v1::SessionOpened opened = ReadOpened(call);
  Estimates estimates;
  v1::EstimateResponse response;
  constexpr uint64_t kLate = 10;  // samples whose estimates are on their way
  uint64_t seq = 0;
  while (response.estimates().durable_seq() == 0 && seq < recording.inputs.size()) {
    v1::EstimateRequest request = Batch(recording, ++seq, 1);
    request.mutable_samples()->set_received_seq(seq > kLate ? seq - kLate : 0);
    call.stream->Write(request);
    ASSERT_TRUE(call.stream->Read(&response));
    Append(response.estimates(), &estimates);
    if (response.estimates().durable_seq() > 0) {
      EXPECT_LE(response.estimates().durable_seq() + kLate, seq);
    }
  }
  ASSERT_GT(response.estimates().durable_seq(), 0u);
  call.context->TryCancel();
  call.stream->Finish();
  Call again = Start(ResumeRequest(opened));
  const uint64_t durable = ReadOpened(again).durable_seq();
  EXPECT_LE(durable + kLate, seq);
  // They come again, the same.
  const Estimates rest = Run(again, recording, durable + 1, seq, 1);
  const size_t per_sample = estimates.size() / seq;
  ExpectIdentical(rest, Estimates(estimates.begin() + static_cast<ptrdiff_t>(durable * per_sample), estimates.end()));
}

TEST_F(EstimationServiceTest, ResumingTakesTheSessionFromItsOldStream) {
  const Recording recording = MakeRecording(20, 0);
  Call first = Start(OpenRequest());
  const v1::SessionOpened opened = ReadOpened(first);
  Run(first, recording, 1, 5, 5);
  Call second = Start(ResumeRequest(opened));
  ReadOpened(second);
  v1::EstimateResponse response;
  EXPECT_FALSE(first.stream->Read(&response));  // ended without a further request
  EXPECT_EQ(first.stream->Finish().error_code(), grpc::StatusCode::ABORTED);
  Run(second, recording, 6, 20, 5);
  EXPECT_TRUE(End(second).ok());
}

TEST_F(EstimationServiceTest, BadSamplesEndTheStreamAndChangeNothing) {
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

TEST_F(EstimationServiceTest, AGapInTimeIsATimeUpdateForEachPeriod) {
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
TEST_F(EstimationServiceTest, LateMeasurementsGoToTheirOwnTimeAndSurviveAResume) {
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

TEST_F(EstimationServiceTest, OutliersAreFlaggedAndBelievedWithoutAGate) {
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

TEST_F(EstimationServiceTest, SamplesMayBringTheirOwnNoise) {
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

TEST_F(EstimationServiceTest, ForecastsAreWhatPassesWithoutMeasurements) {
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

TEST_F(EstimationServiceTest, WhatCannotBeOpenedIsRefused) {
  const auto status_of = [&](const v1::EstimateRequest& first) {
    Call call = Start(first);
    v1::EstimateResponse response;
    EXPECT_FALSE(call.stream->Read(&response));
    return call.stream->Finish();
  };
  EXPECT_EQ(status_of(OpenRequest("models/none")).error_code(), grpc::StatusCode::NOT_FOUND);
  EXPECT_EQ(status_of(OpenRequest("tiny")).error_code(), grpc::StatusCode::INVALID_ARGUMENT);
  v1::EstimateRequest request = OpenRequest();
  request.mutable_open()->mutable_noise()->add_process_noise_cov(-1);
  EXPECT_NE(status_of(request).error_message().find("open.noise.process_noise_cov"), std::string::npos);
  request = OpenRequest();
  for (const double lag : {-1.0, 1e9, kNaN}) {
    request = OpenRequest();
    request.mutable_open()->set_max_lag_s(lag);
    EXPECT_NE(status_of(request).error_message().find("open.max_lag_s"), std::string::npos) << lag;
  }
  request = OpenRequest();
  request.mutable_open()->mutable_gate()->set_probability(1);
  EXPECT_NE(status_of(request).error_message().find("open.gate.probability"), std::string::npos);
  request = OpenRequest();
  request.mutable_open()->mutable_gate()->set_recover_after(-1);
  EXPECT_NE(status_of(request).error_message().find("open.gate.recover_after"), std::string::npos);
  request = OpenRequest();
  request.mutable_open()->set_sample_period_s(7);
  EXPECT_NE(status_of(request).error_message().find("open.sample_period_s"), std::string::npos);
  EXPECT_EQ(status_of(Batch(MakeRecording(3, 0), 1, 3)).error_code(), grpc::StatusCode::INVALID_ARGUMENT);
  v1::SessionOpened wrong;
  wrong.set_session("sessions/1");
  wrong.set_token("guess");
  EXPECT_EQ(status_of(ResumeRequest(wrong)).error_code(), grpc::StatusCode::NOT_FOUND);
}

TEST_F(EstimationServiceTest, SessionsAreListedAndDeleted) {
  Call call = Start(OpenRequest());
  const v1::SessionOpened opened = ReadOpened(call);
  Run(call, MakeRecording(5, 0), 1, 5, 5);
  grpc::ClientContext list_context, get_context, delete_context;
  v1::ListSessionsResponse list;
  ASSERT_TRUE(stub_->ListSessions(&list_context, {}, &list).ok());
  ASSERT_EQ(list.sessions_size(), 1);
  EXPECT_EQ(list.sessions(0).target(), "models/tiny/versions/1");
  EXPECT_EQ(list.sessions(0).applied_seq(), 5u);
  EXPECT_TRUE(list.sessions(0).streaming());
  google::protobuf::Empty empty;
  ASSERT_TRUE(stub_->DeleteSession(&delete_context, Named<v1::DeleteSessionRequest>(opened.session()), &empty).ok());
  v1::EstimateResponse response;
  EXPECT_FALSE(call.stream->Read(&response));
  EXPECT_EQ(call.stream->Finish().error_code(), grpc::StatusCode::ABORTED);
  v1::Session session;
  EXPECT_EQ(stub_->GetSession(&get_context, Named<v1::GetSessionRequest>(opened.session()), &session).error_code(),
            grpc::StatusCode::NOT_FOUND);
}

}  // namespace
}  // namespace metaekf::server
