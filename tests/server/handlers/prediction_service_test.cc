#include <cmath>
#include <limits>

#include "core/nssm/predict.h"
#include "server/convert/samples.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

using ::testing::SizeIs;

constexpr auto kInvalid = absl::StatusCode::kInvalidArgument;
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

std::vector<v1::PredictRequest> PredictRequests(const std::string& target,
                                                v1::PredictRequest::Mode mode,
                                                const std::vector<v1::Samples>& samples) {
  std::vector<v1::PredictRequest> requests(1);
  requests[0].mutable_header()->set_target(target);
  requests[0].mutable_header()->set_mode(mode);
  for (const v1::Samples& s : samples) *requests.emplace_back().mutable_samples() = s;
  return requests;
}

/// What core predicts.
Eigen::MatrixXd Expected(const nssm::Bundle& bundle, const v1::Samples& samples,
                         nssm::PredictionMode mode) {
  TrajectoryAssembler assembler({.channels = {1, 1, 0}, .max_samples = 100'000});
  EXPECT_TRUE(assembler.Add(samples).ok());
  return nssm::Predict(bundle, *assembler.Finish(), mode)->outputs;
}

/// All responses of one trajectory put together; checks that they come in order.
std::vector<double> Outputs(const std::vector<v1::PredictResponse>& responses,
                            const std::string& trajectory) {
  std::vector<double> outputs;
  for (const auto& response : responses) {
    if (response.trajectory() != trajectory) continue;
    EXPECT_EQ(response.first_sample(), outputs.size());
    EXPECT_EQ(static_cast<int>(response.sample_count()), response.outputs_size());
    outputs.insert(outputs.end(), response.outputs().begin(), response.outputs().end());
  }
  return outputs;
}

void ExpectSame(const std::vector<double>& actual, const Eigen::MatrixXd& expected) {
  ASSERT_EQ(static_cast<Eigen::Index>(actual.size()), expected.cols());
  for (size_t t = 0; t < actual.size(); ++t) {
    const double value = expected(0, static_cast<Eigen::Index>(t));
    EXPECT_TRUE(actual[t] == value || (std::isnan(actual[t]) && std::isnan(value))) << t;
  }
}

class PredictionServiceTest : public ServerTest {
 protected:
  void SetUp() override {
    ServerTest::SetUp();
    Import("robot", TinyBundle());
    Import("state", TinyStateBundle());
  }
};

TEST_F(PredictionServiceTest, EverySampleOfEveryTrajectoryIsAnsweredAsByCore) {
  // Long enough for several responses.
  std::vector<v1::Samples> samples = {TinyContext(40'000), TinyFleet()[0]};
  for (const auto mode : {v1::PredictRequest::ONE_STEP, v1::PredictRequest::SIMULATE}) {
    const auto reply = client_->Predict(PredictRequests("models/robot", mode, samples));
    ASSERT_TRUE(reply.ok()) << reply;
    EXPECT_GT(reply.value.size(), 3u);
    EXPECT_EQ(reply.value[0].warmup_samples(), 3u);  // the window
    const auto core_mode = mode == v1::PredictRequest::ONE_STEP ? nssm::PredictionMode::kOneStep
                                                                : nssm::PredictionMode::kSimulate;
    for (const v1::Samples& s : samples) {
      ExpectSame(Outputs(reply.value, s.trajectory()), Expected(TinyBundle(), s, core_mode));
    }
  }
}

TEST_F(PredictionServiceTest, ATrajectoryMayComeInPieces) {
  const v1::Samples whole = TinyContext(50);
  v1::Samples first = whole, second = whole;
  first.set_sample_count(20);
  first.mutable_inputs()->Truncate(20);
  first.mutable_outputs()->Truncate(20);
  second.set_sample_count(30);
  second.mutable_inputs()->erase(second.inputs().begin(), second.inputs().begin() + 20);
  second.mutable_outputs()->erase(second.outputs().begin(), second.outputs().begin() + 20);
  const auto reply = client_->Predict(
      PredictRequests("models/robot", v1::PredictRequest::SIMULATE, {first, second}));
  ASSERT_TRUE(reply.ok()) << reply;
  ExpectSame(Outputs(reply.value, "new"),
             Expected(TinyBundle(), whole, nssm::PredictionMode::kSimulate));
}

TEST_F(PredictionServiceTest, AnAdaptationPredictsWithItsOwnParameters) {
  std::vector<v1::AdaptRequest> adapt(2);
  adapt[0].mutable_options()->set_model("models/robot");
  adapt[0].mutable_options()->set_adaptation_id("mine");
  *adapt[1].mutable_samples() = TinyContext(60);
  ASSERT_TRUE(client_->Adapt(adapt).ok());
  const auto predict = [&](const std::string& target) {
    return Outputs(
        client_->Predict(PredictRequests(target, v1::PredictRequest::ONE_STEP, {TinyContext(30)}))
            .value,
        "new");
  };
  const auto adapted = predict("adaptations/mine"), base = predict("models/robot/versions/1");
  ASSERT_THAT(adapted, SizeIs(30));
  EXPECT_NE(adapted[10], base[10]);
}

TEST_F(PredictionServiceTest, AFreeRunNeedsTheStartOnly) {
  v1::Samples samples = TinyContext(30);
  for (int t = 3; t < 30; ++t) samples.set_outputs(t, kNaN);
  auto reply =
      client_->Predict(PredictRequests("models/robot", v1::PredictRequest::SIMULATE, {samples}));
  ASSERT_TRUE(reply.ok()) << reply;
  ExpectSame(Outputs(reply.value, "new"),
             Expected(TinyBundle(), TinyContext(30), nssm::PredictionMode::kSimulate));
  samples.set_outputs(2, kNaN);
  ExpectError(
      client_->Predict(PredictRequests("models/robot", v1::PredictRequest::SIMULATE, {samples})),
      kInvalid, {"samples.outputs"});

  // Case II starts from the first state.
  samples = TinyContext(30);
  samples.clear_outputs();
  for (int t = 0; t < 30; ++t) {
    samples.add_states(t == 0 ? 0.1 : kNaN);
    samples.add_states(t == 0 ? -0.2 : kNaN);
  }
  reply =
      client_->Predict(PredictRequests("models/state", v1::PredictRequest::SIMULATE, {samples}));
  ASSERT_TRUE(reply.ok()) << reply;
  EXPECT_EQ(reply.value[0].states_size(), 60);
  EXPECT_TRUE(std::isfinite(reply.value[0].states(59)));
  samples.clear_states();
  ExpectError(
      client_->Predict(PredictRequests("models/state", v1::PredictRequest::SIMULATE, {samples})),
      kInvalid, {"samples.states"});
}

TEST_F(PredictionServiceTest, WrongRequestsAreRefused) {
  const auto mode = v1::PredictRequest::ONE_STEP;
  const v1::Samples good = TinyContext(30);
  const auto predict = [&](const std::string& target, v1::PredictRequest::Mode m,
                           const v1::Samples& samples) {
    return client_->Predict(PredictRequests(target, m, {samples}));
  };
  ExpectError(predict("models/robot", v1::PredictRequest::MODE_UNSPECIFIED, good), kInvalid,
              {"header.mode"});
  ExpectError(predict("robot", mode, good), kInvalid, {"header.target"});
  ExpectError(predict("models/other", mode, good), absl::StatusCode::kNotFound);
  ExpectError(predict("adaptations/a1", mode, good), absl::StatusCode::kNotFound);
  v1::Samples bad = good;
  bad.set_inputs(4, kNaN);
  ExpectError(predict("models/robot", mode, bad), kInvalid, {"samples.inputs[4]"});
  bad = good;
  bad.set_sample_count(0);
  ExpectError(predict("models/robot", mode, bad), kInvalid, {"samples.sample_count"});
  ExpectError(predict("models/robot", mode, TinyContext(3)), absl::StatusCode::kFailedPrecondition);
  ExpectError(client_->Predict({}), kInvalid, {"header"});
  ExpectError(client_->Predict(PredictRequests("models/robot", mode, {})), kInvalid, {"samples"});

  auto requests = PredictRequests("models/robot", mode, {good});
  requests[0].mutable_header()->mutable_channels()->add_outputs()->set_name("y1");
  ExpectError(client_->Predict(requests), kInvalid, {"header.channels.inputs"});
}

}  // namespace
}  // namespace metaekf::server
