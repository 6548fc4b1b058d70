#include <cmath>

#include "core/filter/smoother.h"
#include "server/convert/samples.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

constexpr auto kInvalid = absl::StatusCode::kInvalidArgument;

std::vector<v1::SmoothRequest> SmoothRequests(const std::string& target, const std::vector<v1::Samples>& samples) {
  std::vector<v1::SmoothRequest> requests(1);
  requests[0].mutable_header()->set_target(target);
  requests[0].mutable_header()->set_covariance_format(v1::OpenSession::LOWER_TRIANGLE);
  for (const v1::Samples& s : samples) *requests.emplace_back().mutable_samples() = s;
  return requests;
}

class SmoothingServiceTest : public ServerTest {
 protected:
  void SetUp() override {
    ServerTest::SetUp();
    Import("robot", TinyBundle());
    Import("state", TinyStateBundle());
  }
};

TEST_F(SmoothingServiceTest, EverySampleIsAnsweredAsByCore) {
  v1::Samples context = TinyContext(20'000);
  context.mutable_outputs()->at(7) = std::nan("");
  context.clear_states();
  for (const char* name : {"robot", "state"}) {
    const nssm::Bundle bundle = std::string(name) == "robot" ? TinyBundle() : TinyStateBundle();
    TrajectoryAssembler assembler({.channels = {1, 1, 0}, .missing_measurements = true, .max_samples = 100'000});
    ASSERT_TRUE(assembler.Add(context).ok());
    const std::shared_ptr<filter::FilterModel> model = filter::FilterModel::Create(bundle);
    const auto scratch = model->MakeScratch();
    const filter::Ekf ekf = *filter::Ekf::Create(bundle, model, model->Prepare(bundle.parameters), {});
    const auto expected = *filter::Smooth(ekf, *assembler.Finish(), scratch.get());

    const auto reply = client_->Smooth(SmoothRequests(std::string("models/") + name, {context}));
    ASSERT_TRUE(reply.ok()) << reply;
    EXPECT_GT(reply.value.size(), 3u);  // long enough for several responses
    EXPECT_EQ(reply.value[0].estimated_size(), static_cast<int>(expected[0].mean.size()));
    size_t t = 0;
    for (const v1::SmoothResponse& response : reply.value) {
      const v1::EstimateBatch& batch = response.estimates();
      EXPECT_EQ(batch.first_seq(), t + 1);
      const int n = batch.means_size() / batch.nis_size();
      for (int row = 0; row < batch.nis_size(); ++row, ++t) {
        for (int i = 0; i < n; ++i) {
          const double value = expected[t].mean[i];
          EXPECT_TRUE(batch.means(row * n + i) == value || std::isnan(value)) << t;
        }
        EXPECT_EQ(batch.flags(row) & v1::EstimateBatch::MISSING, t == 7 ? 1u : 0u);
      }
    }
    EXPECT_EQ(t, expected.size());
  }
}

TEST_F(SmoothingServiceTest, MoreThanTheServerHoldsIsRefused) {
  Stop();
  options_.limits.sample_bytes = 1 << 20;
  Start();
  v1::Samples samples = TinyContext(10'000);
  const auto reply = client_->Smooth(SmoothRequests("models/robot", {samples}));
  EXPECT_EQ(reply.code, absl::StatusCode::kResourceExhausted);
  EXPECT_NE(reply.message.find("limits.sample_bytes"), std::string::npos) << reply.message;
  // One after the other is no more at a time than one.
  std::vector<v1::Samples> pieces;
  for (int piece = 0; piece < 40; ++piece) {
    pieces.push_back(TinyContext(500));
    pieces.back().set_trajectory(std::to_string(piece));
  }
  EXPECT_TRUE(client_->Smooth(SmoothRequests("models/robot", pieces)).ok());
}

TEST_F(SmoothingServiceTest, WrongRequestsAreRefused) {
  const v1::Samples context = TinyContext(20);
  const auto status_of = [&](const std::vector<v1::SmoothRequest>& requests) { return client_->Smooth(requests); };
  EXPECT_EQ(status_of({}).code, kInvalid);
  EXPECT_EQ(status_of(SmoothRequests("models/none", {context})).code, absl::StatusCode::kNotFound);
  EXPECT_EQ(status_of(SmoothRequests("models/robot", {})).code, kInvalid);
  auto requests = SmoothRequests("models/robot", {context});
  requests[0].mutable_header()->mutable_noise()->add_process_noise_cov(-1);
  EXPECT_NE(status_of(requests).message.find("header.noise.process_noise_cov"), std::string::npos);
  requests = SmoothRequests("models/robot", {context});
  requests[0].mutable_header()->mutable_gate()->set_probability(2);
  EXPECT_NE(status_of(requests).message.find("header.gate.probability"), std::string::npos);
  requests = SmoothRequests("models/robot", {context, context});
  std::swap(requests[0], requests[1]);
  EXPECT_EQ(status_of(requests).code, kInvalid);
}

}  // namespace
}  // namespace metaekf::server
