#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <thread>

#include "metaekf/client.h"
#include "tests/client/fake_server.h"

namespace metaekf::client {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

class EstimationTest : public ::testing::Test {
 protected:
  std::unique_ptr<EstimationSession> Open(EstimationOptions options = {}) {
    options.target.model = "vdp";
    auto session = client_.OpenEstimation(options);
    EXPECT_TRUE(session.ok()) << session.status().message;
    return std::move(*session);
  }
  static SampleBatch Batch(const std::vector<double>& outputs) {
    return {.samples = outputs.size(),
            .inputs = std::vector<double>(outputs.size(), 0.0),
            .outputs = outputs};
  }

  metaekf::testing::FakeServer server_;
  Client client_{{.server = server_.address()}};
};

TEST_F(EstimationTest, SendsAndReceivesInOneThread) {
  const auto session = Open({.noise = {.measurement_noise_cov = {2}}});
  EXPECT_EQ(session->info().session, "5");
  EXPECT_EQ(session->info().model_version, 2U);
  EXPECT_EQ(server_.estimation.open.noise().measurement_noise_cov(0), 2);
  for (uint64_t i = 1; i <= 3; ++i) {
    const auto last = session->Send(Batch({static_cast<double>(i), std::nan("")}));
    ASSERT_TRUE(last.ok());
    EXPECT_EQ(*last, 2 * i);
    const auto batch = session->Receive();
    ASSERT_TRUE(batch.ok() && batch->has_value());
    EXPECT_EQ((*batch)->first_seq, 2 * i - 1);
    EXPECT_THAT((*batch)->means, ElementsAre(i, i));
    EXPECT_THAT((*batch)->flags, ElementsAre(0, kMissing));
    EXPECT_EQ((*batch)->health[0], Health::kConsistent);
  }
  session->FinishSending();
  const auto end = session->Receive();
  ASSERT_TRUE(end.ok()) << end.status().message;
  EXPECT_FALSE(end->has_value());
}

TEST_F(EstimationTest, ForecastsComeInTheirTurn) {
  const auto session = Open();
  ASSERT_TRUE(session->Send(Batch({1, 2})).ok());
  ASSERT_TRUE(session->AskForecast(3).ok());
  ASSERT_TRUE(session->Send(Batch({5})).ok());
  const auto first = session->Receive(), forecast = session->Receive(), last = session->Receive();
  ASSERT_TRUE(first.ok() && forecast.ok() && last.ok());
  EXPECT_FALSE((*first)->forecast);
  EXPECT_TRUE((*forecast)->forecast);
  EXPECT_THAT((*forecast)->means, ElementsAre(2, 2, 2));
  EXPECT_THAT((*last)->means, ElementsAre(5));
  EXPECT_EQ((*last)->first_seq, 3U);
}

TEST_F(EstimationTest, SendingWaitsForAnswersBeyondTheLimit) {
  const auto session = Open({.max_in_flight = 4});
  std::thread sender([&] {
    for (int i = 0; i < 100; ++i) EXPECT_TRUE(session->Send(Batch({1.0 * i})).ok());
    session->FinishSending();
  });
  uint64_t received = 0;
  while (true) {
    const auto batch = session->Receive();
    ASSERT_TRUE(batch.ok()) << batch.status().message;
    if (!*batch) break;
    received += (*batch)->samples;
  }
  sender.join();
  EXPECT_EQ(received, 100U);
}

TEST_F(EstimationTest, RefusesSizesThatDoNotFit) {
  const auto session = Open();
  EXPECT_THAT(session->Send({.samples = 2, .inputs = {1, 2}, .outputs = {1}}).status().message,
              HasSubstr("1 values of outputs for 2 samples"));
  EXPECT_EQ(session->Send({.samples = 1, .outputs = {1}}).status().code, Code::kInvalidArgument);
  EXPECT_EQ(session->Send(SampleBatch()).status().code, Code::kInvalidArgument);
  SampleBatch times = Batch({1, 2});
  times.times_s = {0};
  EXPECT_EQ(session->Send(times).status().code, Code::kInvalidArgument);
}

TEST_F(EstimationTest, AnUnknownTargetIsTheErrorOfOpening) {
  EXPECT_EQ(client_.OpenEstimation({.target = {.model = "gone"}}).status().code, Code::kNotFound);
}

TEST_F(EstimationTest, ResumingSendsAgainWhatIsNotDurable) {
  server_.estimation.make_durable = true;
  server_.estimation.stop_after_batches = 3;
  const auto session = Open({.reconnect_for_s = 0});
  for (const double y : {10, 20, 30}) {
    ASSERT_TRUE(session->Send(Batch({y, y + 1})).ok());
    ASSERT_TRUE(session->Receive().ok());
  }
  const Status broken = session->Receive().status();
  EXPECT_EQ(broken.code, Code::kUnavailable);
  EXPECT_EQ(broken.reason, "DRAINING");
  EXPECT_FALSE(session->Send(Batch({1})).ok());
  EXPECT_EQ(session->durable_seq(), 4U);

  ASSERT_TRUE(session->Resume().ok());
  EXPECT_EQ(session->info().epoch, 2U);
  const auto again = session->Receive();
  ASSERT_TRUE(again.ok()) << again.status().message;
  // Samples 1 to 4 are durable; 5 and 6 come again, then the next number.
  EXPECT_EQ((*again)->first_seq, 5U);
  EXPECT_THAT((*again)->means, ElementsAre(30, 31));
  EXPECT_EQ(*session->Send(Batch({40})), 7U);
  EXPECT_EQ((*session->Receive())->first_seq, 7U);
  EXPECT_EQ(server_.estimation.batches.size(), 5U);
}

TEST_F(EstimationTest, ResumingWithoutTheSamplesNeededIsAnError) {
  // Nothing is durable and two samples are kept, so that samples 1 and 2 are gone.
  server_.estimation.stop_after_batches = 4;
  const auto session = Open({.max_kept = 2, .reconnect_for_s = 0});
  for (const double y : {1, 2, 3, 4}) {
    ASSERT_TRUE(session->Send(Batch({y})).ok());
    ASSERT_TRUE(session->Receive().ok());
  }
  EXPECT_FALSE(session->Receive().ok());
  const Status status = session->Resume();
  EXPECT_EQ(status.code, Code::kDataLoss);
  EXPECT_THAT(status.message, HasSubstr("sample 1"));
}

TEST_F(EstimationTest, AnotherProcessResumesWithTheToken) {
  server_.estimation.durable_seq = 8;
  const auto session = client_.ResumeEstimation("5", "secret");
  ASSERT_TRUE(session.ok()) << session.status().message;
  EXPECT_EQ((*session)->info().durable_seq, 8U);
  EXPECT_EQ((*session)->info().token, "secret");
  EXPECT_EQ(*(*session)->Send(Batch({1})), 9U);
  EXPECT_EQ(client_.ResumeEstimation("5", "guess").status().code, Code::kNotFound);
}

TEST_F(EstimationTest, TheStreamEndsWithTheServer) {
  const auto session = Open({.reconnect_for_s = 0});
  server_.Stop();
  EXPECT_EQ(session->Receive().status().code, Code::kUnavailable);
  EXPECT_EQ(session->Receive().status().code, Code::kUnavailable);
}

TEST_F(EstimationTest, ALostStreamGoesOnByItself) {
  server_.estimation.make_durable = true;
  server_.estimation.stop_after_batches = 3;
  const auto session = Open();
  for (uint64_t i = 1; i <= 6; ++i) {
    EXPECT_EQ(*session->Send(Batch({10.0 * i, 10.0 * i + 1})), 2 * i);
    const auto batch = session->Receive();
    ASSERT_TRUE(batch.ok()) << batch.status().message;
    EXPECT_EQ((*batch)->first_seq, 2 * i - 1);
    EXPECT_THAT((*batch)->means, ElementsAre(10.0 * i, 10.0 * i + 1));
  }
  EXPECT_EQ(server_.estimation.epoch, 2U);
  // The server had answered the third, but not made it durable: it came again.
  EXPECT_EQ(server_.estimation.batches.size(), 7U);
}

TEST_F(EstimationTest, HoweverOftenItIsLostNoEstimateIsMissedAndNoneComesTwice) {
  server_.estimation.make_durable = true;
  server_.estimation.stop_after_batches = server_.estimation.then_stop_after_batches = 7;
  const auto session = Open({.max_in_flight = 10});
  constexpr uint64_t kSamples = 120;
  std::thread sender([&] {
    for (uint64_t i = 1; i <= kSamples; ++i) EXPECT_TRUE(session->Send(Batch({1.0 * i})).ok());
    session->FinishSending();
  });
  uint64_t received = 0;
  while (true) {
    const auto batch = session->Receive();
    ASSERT_TRUE(batch.ok()) << batch.status().message;
    if (!*batch) break;
    for (size_t i = 0; i < (*batch)->samples; ++i) EXPECT_EQ((*batch)->means[i], (*batch)->first_seq + i);
    EXPECT_EQ((*batch)->first_seq, received + 1);
    received += (*batch)->samples;
  }
  sender.join();
  EXPECT_EQ(received, kSamples);
  EXPECT_GT(server_.estimation.epoch, kSamples / 7);
}

TEST_F(EstimationTest, AForecastThatWasNotAnsweredIsAskedForAgain) {
  server_.estimation.stop_after_batches = 1;
  const auto session = Open();
  ASSERT_TRUE(session->Send(Batch({5})).ok());
  ASSERT_TRUE(session->AskForecast(2).ok());
  const auto estimate = session->Receive(), forecast = session->Receive();
  ASSERT_TRUE(estimate.ok() && forecast.ok()) << forecast.status().message;
  EXPECT_TRUE((*forecast)->forecast);
  EXPECT_THAT((*forecast)->means, ElementsAre(5, 5));
}

TEST_F(EstimationTest, GivingUpSaysWhatTheServerHas) {
  server_.estimation.durable_seq = 3;
  const auto session = Open({.reconnect_for_s = 0.5});
  server_.Stop();
  const Status status = session->Receive().status();
  EXPECT_EQ(status.code, Code::kUnavailable);
  EXPECT_THAT(status.message, HasSubstr("gave up"));
  EXPECT_EQ(status.metadata.at("durable_seq"), "3");
  EXPECT_FALSE(session->Send(Batch({1})).ok());
}

TEST_F(EstimationTest, WhatDoesNotPassIsToldAtOnce) {
  server_.estimation.stop_after_batches = 1;
  const auto session = client_.ResumeEstimation("5", "secret");
  ASSERT_TRUE(session.ok());
  ASSERT_TRUE((*session)->Send(Batch({1})).ok());
  ASSERT_TRUE((*session)->Receive().ok());
  server_.estimation.secret = "another";
  EXPECT_EQ((*session)->Receive().status().code, Code::kNotFound);
}

}  // namespace
}  // namespace metaekf::client
