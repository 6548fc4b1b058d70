// Streams and the sessions behind them.

#include <thread>

#include "tests/server/session/estimation_test.h"

namespace metaekf::server {
namespace {

using EstimationServiceTest = EstimationTest;

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
