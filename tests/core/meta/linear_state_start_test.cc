#include "core/meta/linear_state_start.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "core/base/rng.h"
#include "core/nssm/predict.h"
#include "tests/support/bundles.h"

namespace metaekf::meta {
namespace {

using data::Trajectory;
using Eigen::Index;
using Eigen::MatrixXd;
using ::testing::HasSubstr;

nssm::ModelSpec ThreeStates() {
  nssm::ModelSpec spec{.kind = nssm::Case::kStateInputOutput, .input_size = 1, .output_size = 2, .state_size = 3, .latent_size = 5, .window = 1};
  spec.transition.bypass = nssm::Bypass::kLinear;
  spec.transition.form = nssm::TransitionForm::kAutonomous;
  spec.transition.block.hidden_widths = {4};
  spec.precision = nssm::Precision::kFloat64;
  return spec;
}

/// x⁺ = A x + B u, y = C x, where the third state follows the second within 1e-3.
Trajectory LinearSystem(Index count, uint64_t seed) {
  base::Rng rng(seed);
  MatrixXd A(3, 3), C(2, 3);
  A << 0.9, 0.2, 0, -0.3, 0.8, 0, -0.3, 0.8, 0.001;
  C << 1, 0, 0.5, 0, 1, -1;
  const Eigen::Vector3d B(0.1, 0.5, 0.499);
  Trajectory t{.name = "linear", .sample_period_s = 1, .inputs = MatrixXd(1, count), .outputs = MatrixXd(2, count), .states = MatrixXd(3, count)};
  Eigen::Vector3d x = Eigen::Vector3d::Zero();
  for (Index k = 0; k < count; ++k) {
    t.inputs(0, k) = rng.Normal();
    t.states.col(k) = x;
    t.outputs.col(k) = C * x;
    x = A * x + B * t.inputs(0, k);
  }
  return t;
}

/// Of predictions one step ahead, in the states' units.
double OneStepError(const nssm::Model& model, const std::vector<double>& parameters, const Trajectory& recording) {
  nssm::Bundle bundle = support::UnitBundle(model);
  bundle.parameters = parameters;
  const auto prediction = nssm::Predict(bundle, recording, nssm::PredictionMode::kOneStep);
  EXPECT_TRUE(prediction.ok()) << prediction.status();
  const Index n = recording.length() - 1;
  return (prediction->states.rightCols(n) - recording.states.rightCols(n)).cwiseAbs().maxCoeff();
}

TEST(LinearStateStartTest, PredictsALinearSystemFromTheStart) {
  const nssm::Model model = *nssm::Model::Create(ThreeStates());
  const Trajectory recording = LinearSystem(3000, 1);
  auto parameters = LinearStateStart(model, {recording}, 7);
  ASSERT_TRUE(parameters.ok()) << parameters.status();
  nn::TensorIn(model.layout(), "transition.1.weight", *parameters).setZero();  // the network beside it
  // What the ridge takes away: a ten-thousandth of what a deviation does.
  EXPECT_LT(OneStepError(model, *parameters, LinearSystem(100, 2)), 2e-3);
  EXPECT_GT(OneStepError(model, model.InitialParameters(7), LinearSystem(100, 2)), 0.1);
}

TEST(LinearStateStartTest, LatentsAreUncorrelatedAndDecodeExactly) {
  const nssm::Model model = *nssm::Model::Create(ThreeStates());
  const Trajectory recording = LinearSystem(3000, 1);
  auto parameters = LinearStateStart(model, {recording}, 7);
  ASSERT_TRUE(parameters.ok()) << parameters.status();
  const MatrixXd encoder = nn::TensorIn(model.layout(), "encoder.0.weight", *parameters);
  const MatrixXd decoder = nn::TensorIn(model.layout(), "state_decoder.0.weight", *parameters);
  EXPECT_LT((decoder * encoder - MatrixXd::Identity(3, 4)).cwiseAbs().maxCoeff(), 1e-10);
  MatrixXd v(4, 2999);
  v << recording.states.leftCols(2999), recording.inputs.leftCols(2999);
  const MatrixXd latents = encoder.topRows(4) * v, moments = latents * latents.transpose() / 2999;
  for (Index i = 0; i < 4; ++i) {
    EXPECT_LE(moments(i, i), 1) << i;
    for (Index j = 0; j < i; ++j) EXPECT_NEAR(moments(i, j), 0, 1e-9) << i << ", " << j;
  }
}

TEST(LinearStateStartTest, SaysWhatIsInTheWay) {
  const auto message = [](const auto& change) {
    nssm::ModelSpec spec = ThreeStates();
    change(&spec);
    return std::string(CheckLinearStateStart(spec).message());
  };
  EXPECT_EQ(message([](nssm::ModelSpec*) {}), "");
  EXPECT_THAT(message([](nssm::ModelSpec* spec) { spec->kind = nssm::Case::kInputOutput; }), HasSubstr("Case II"));
  EXPECT_THAT(message([](nssm::ModelSpec* spec) { spec->transition.bypass = nssm::Bypass::kSkip; }), HasSubstr("LINEAR"));
  EXPECT_THAT(message([](nssm::ModelSpec* spec) { spec->encoder.hidden_widths = {8}; }), HasSubstr("hidden"));
  EXPECT_THAT(message([](nssm::ModelSpec* spec) { spec->latent_size = 3; }), HasSubstr("at least 4"));
}

}  // namespace
}  // namespace metaekf::meta
