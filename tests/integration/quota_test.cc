// Quotas, and more work than a server has places for, as clients meet them.

#include <grpcpp/grpcpp.h>

#include <atomic>
#include <chrono>
#include <thread>
#include <vector>

#include "metaekf/client.h"
#include "metaekf/v1/adaptation.grpc.pb.h"
#include "tests/server/support/metric.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

using ::testing::HasSubstr;
using std::chrono::steady_clock;

class QuotaTest : public ServerTest {
 protected:
  QuotaTest() { options_.quotas.others = {.sessions = 1, .samples_per_s = 200}; }
};

TEST_F(QuotaTest, AStreamThatSendsFasterIsSlowedDownAndLosesNothing) {
  Import("robot", TinyBundle());
  client::Client client({.server = server_->address()});
  client::EstimationOptions options;
  options.target.model = "robot";
  const auto session = client.OpenEstimation(options);
  ASSERT_TRUE(session.ok()) << session.status().message;
  const auto start = steady_clock::now();
  constexpr int kBatches = 40, kSamples = 10;  // twice what a second allows
  for (int batch = 0; batch < kBatches; ++batch) {
    ASSERT_TRUE((*session)
                    ->Send({.samples = kSamples,
                            .inputs = std::vector<double>(kSamples, 0.5),
                            .outputs = std::vector<double>(kSamples, 0.1)})
                    .ok());
  }
  (*session)->FinishSending();
  size_t received = 0;
  while (true) {
    const auto batch = (*session)->Receive();
    ASSERT_TRUE(batch.ok()) << batch.status().message;
    if (!*batch) break;
    received += (*batch)->samples;
  }
  EXPECT_EQ(received, kBatches * kSamples);
  // The first second's come at once, the last batch once all but it are paid for.
  EXPECT_GE(steady_clock::now() - start, std::chrono::milliseconds(900));
}

TEST_F(QuotaTest, ASessionTooManyIsRefusedWithTheReason) {
  Import("robot", TinyBundle());
  client::Client client({.server = server_->address()});
  client::EstimationOptions options;
  options.target.model = "robot";
  const auto first = client.OpenEstimation(options);
  ASSERT_TRUE(first.ok());
  const client::Status second = client.OpenEstimation(options).status();
  EXPECT_EQ(second.code, client::Code::kResourceExhausted);
  EXPECT_THAT(second.message, HasSubstr("1 sessions, and its quota is 1"));
  EXPECT_TRUE((*first)->Send({.samples = 1, .inputs = {0.5}, .outputs = {0.1}}).ok());
  EXPECT_TRUE((*first)->Receive().ok());
}

class OverloadTest : public ServerTest {
 protected:
  static constexpr int kPlaces = 3;
  OverloadTest() {
    options_.compute_threads = 1;
    options_.limits.queued_calls = kPlaces;
  }
};

TEST_F(OverloadTest, AnAdaptationThatHasNoPlaceIsRefusedBeforeItsContextIsSent) {
  Import("robot", TinyBundle());
  client::AdaptationRequest long_one{.model = "robot"};
  long_one.inner_loop.steps = 50'000;
  long_one.inner_loop.learning_rate = 1e-9;
  long_one.context = {.samples = 60, .inputs = std::vector<double>(60, 0.5), .outputs = std::vector<double>(60, 0.1)};
  std::atomic<bool> enough = false, ended = false;
  std::vector<std::thread> clients;
  for (int call = 0; call <= kPlaces; ++call) {  // one of them is at work
    clients.emplace_back([&] {
      const auto adapted = client::Client({.server = server_->address()}).Adapt(long_one, [&](const auto&) { return !enough; });
      EXPECT_EQ(adapted.status().code, client::Code::kCancelled) << adapted.status().message;
      ended = true;
    });
    while (Metric(server_->address(), "metaekf_queued_calls", {{"threads", "compute"}}) < call && !ended) continue;
  }

  const auto stub = v1::AdaptationService::NewStub(grpc::CreateChannel(server_->address(), grpc::InsecureChannelCredentials()));
  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(60));
  const grpc::Status status = stub->Adapt(&context)->Finish();
  EXPECT_EQ(status.error_code(), grpc::StatusCode::RESOURCE_EXHAUSTED) << status.error_message();
  enough = true;
  for (std::thread& client : clients) client.join();
}

}  // namespace
}  // namespace metaekf::server
