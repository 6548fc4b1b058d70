#include "core/nssm/linearise.h"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>

#include "core/base/rng.h"
#include "tests/core/nssm/random_models.h"
#include "tests/support/bundles.h"

namespace metaekf::nssm {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double kStep = 1e-6;

VectorXd RandomVector(base::Rng* rng, Index n) {
  VectorXd v(n);
  for (double& value : v) value = rng->Normal();
  return v;
}

TEST(LineariseTest, JacobiansMatchCentralDifferencesForEveryKindOfModel) {
  for (const ModelCase& c : ModelCases()) {
    SCOPED_TRACE(c.name);
    const Model model = *Model::Create(c.model);
    const std::vector<double> parameters = RandomParameters(model, 5);
    base::Rng rng(9);
    const Index n = c.model.is_case_one() ? c.model.latent_size : c.model.state_size;
    const VectorXd x = RandomVector(&rng, n), u = RandomVector(&rng, c.model.input_size);
    const Linearisation l = Linearise(model, parameters, x, u);
    const auto check = [&](const MatrixXd& f_jacobian, const MatrixXd& h_jacobian, const VectorXd& point, auto at) {
      for (Index j = 0; j < point.size(); ++j) {
        VectorXd up = point, down = point;
        up[j] += kStep;
        down[j] -= kStep;
        const Linearisation a = at(up), b = at(down);
        EXPECT_LT((f_jacobian.col(j) - (a.f - b.f) / (2 * kStep)).norm(), 1e-7 * (1 + f_jacobian.norm()));
        EXPECT_LT((h_jacobian.col(j) - (a.h - b.h) / (2 * kStep)).norm(), 1e-7 * (1 + h_jacobian.norm()));
      }
    };
    check(l.A, l.C, x, [&](const VectorXd& v) { return Linearise(model, parameters, v, u); });
    check(l.B, l.D, u, [&](const VectorXd& v) { return Linearise(model, parameters, x, v); });
  }
}

TEST(LineariseTest, RolloutSensitivitiesMatchCentralDifferencesForEveryKindOfModel) {
  for (const ModelCase& c : ModelCases()) {
    SCOPED_TRACE(c.name);
    const Model model = *Model::Create(c.model);
    const std::vector<double> parameters = RandomParameters(model, 5);
    base::Rng rng(9);
    const Index n = c.loss.rollout == RolloutMode::kLatent ? c.model.latent_size : c.model.state_size;
    const VectorXd carry = RandomVector(&rng, n);
    const MatrixXd inputs = RandomTrajectory(c.model, 6, 3).inputs;
    const nn::Mask none(model.layout().tensors().size(), false), all(none.size(), true);
    const RolloutSensitivity s = DifferentiateRollout(model, c.loss.rollout, parameters, all, carry, inputs);
    ASSERT_EQ(s.parameters.cols(), model.layout().size());
    ASSERT_EQ(s.outputs.size(), 6 * c.model.output_size);
    const auto outputs_at = [&](const std::vector<double>& p, const VectorXd& start) {
      return DifferentiateRollout(model, c.loss.rollout, p, none, start, inputs).outputs;
    };
    for (size_t i = 0; i < parameters.size(); ++i) {
      std::vector<double> up = parameters, down = parameters;
      up[i] += kStep;
      down[i] -= kStep;
      const VectorXd slope = (outputs_at(up, carry) - outputs_at(down, carry)) / (2 * kStep);
      EXPECT_LT((s.parameters.col(static_cast<Index>(i)) - slope).norm(), 1e-6 * (1 + s.parameters.norm())) << i;
    }
    for (Index i = 0; i < n; ++i) {
      VectorXd up = carry, down = carry;
      up[i] += kStep;
      down[i] -= kStep;
      const VectorXd slope = (outputs_at(parameters, up) - outputs_at(parameters, down)) / (2 * kStep);
      EXPECT_LT((s.carry.col(i) - slope).norm(), 1e-6 * (1 + s.carry.norm())) << i;
    }
  }
}

// The normaliser stands between the model and rad.
TEST(LineariseTest, AnAngleIsSeenBySineAndCosine) {
  ModelSpec spec{.kind = Case::kStateInputOutput, .input_size = 1, .output_size = 2, .state_size = 2, .latent_size = 2, .window = 1};
  spec.precision = Precision::kFloat64;
  spec.angles.states = {1};
  const double mean = 0.4, scale = 1.5;
  TakeUnits({.states = {Eigen::Vector2d(3, mean), Eigen::Vector2d(2, scale)}}, &spec);
  Bundle bundle = support::UnitBundle(*Model::Create(spec));
  support::SetWeight("encoder.0.weight", Eigen::MatrixXd{{0, 0, 1, 0, 0}, {0, 0, 0, 1, 0}}, &bundle);  // x1, x2, sin, cos, u
  support::SetWeight("output_decoder.0.weight", Eigen::Matrix2d::Identity(), &bundle);
  for (const double angle : {0.7, 0.7 + 2 * std::numbers::pi, -2.0}) {
    const Eigen::Vector2d state(0.2, (angle - mean) / scale);
    const Linearisation at = Linearise(bundle.model, bundle.parameters, state, Eigen::VectorXd::Ones(1));
    EXPECT_NEAR((at.h - Eigen::Vector2d(std::sin(angle), std::cos(angle))).norm(), 0, 1e-14);
    EXPECT_NEAR((at.C - Eigen::Matrix2d{{0, scale * std::cos(angle)}, {0, -scale * std::sin(angle)}}).norm(), 0, 1e-14);
  }
}

TEST(LineariseTest, AMaskPicksColumns) {
  const ModelCase c = ModelCases().front();
  const Model model = *Model::Create(c.model);
  const std::vector<double> parameters = RandomParameters(model, 5);
  const VectorXd carry = VectorXd::Ones(c.model.latent_size);
  const MatrixXd inputs = RandomTrajectory(c.model, 4, 3).inputs;
  const nn::Mask all(model.layout().tensors().size(), true);
  const nn::Mask decoder = *nn::ParseMask("output_decoder", model.layout());
  const MatrixXd full = DifferentiateRollout(model, RolloutMode::kLatent, parameters, all, carry, inputs).parameters;
  const MatrixXd part = DifferentiateRollout(model, RolloutMode::kLatent, parameters, decoder, carry, inputs).parameters;
  EXPECT_EQ(part, full.rightCols(part.cols()));  // the output decoder's tensors stand last
}

}  // namespace
}  // namespace metaekf::nssm
