// Quotas as clients meet them.

#include <chrono>

#include "metaekf/client.h"
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

}  // namespace
}  // namespace metaekf::server
