#include "core/nssm/least_squares.h"

#include <gtest/gtest.h>

#include <limits>

#include "core/base/rng.h"
#include "tests/core/nssm/random_models.h"

namespace metaekf::nssm {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double kStep = 1e-5;

/// A problem with everything that is needed to look at it from outside.
struct Probe {
  Probe(const ModelCase& c, const std::string& mask_text, bool free_start, int32_t samples, int32_t stride)
      : model(*Model::Create(c.model)), parameters(RandomParameters(model, 5)) {
    mask = *nn::ParseMask(mask_text, model.layout());
    LossSpec loss = c.loss;
    loss.stride = stride;
    problem.emplace(model, loss, mask, free_start);
    data = *problem->Cut(RandomTrajectory(c.model, samples, 3));
    workspace.emplace(*problem, data.shape);
    base::Rng rng(4);
    start = VectorXd::Zero(problem->carry_size());
    for (double& value : start) value = rng.Normal();
    weights = VectorXd::LinSpaced(problem->channels(), 0.5, 2);
  }

  NormalEquations At(const std::vector<double>& p, const VectorXd& c0) {
    NormalEquations result;
    problem->Linearise(p.data(), c0, weights, data, &*workspace, &result);
    return result;
  }
  MatrixXd PredictionsAt(const std::vector<double>& p, const VectorXd& c0) {
    return problem->Predictions(p.data(), c0, data, &*workspace);
  }
  /// ∂predictions/∂unknown by central differences.
  MatrixXd Slope(Index unknown) {
    std::vector<double> up = parameters, down = parameters;
    VectorXd start_up = start, start_down = start;
    if (unknown < problem->adapted_size()) {
      int64_t at = unknown;
      for (const auto& [offset, size] : problem->adapted()) {
        if (at < 0) break;
        if (at < size) {
          up[static_cast<size_t>(offset + at)] += kStep;
          down[static_cast<size_t>(offset + at)] -= kStep;
        }
        at -= size;
      }
    } else {
      start_up[unknown - problem->adapted_size()] += kStep;
      start_down[unknown - problem->adapted_size()] -= kStep;
    }
    return (PredictionsAt(up, start_up) - PredictionsAt(down, start_down)) / (2 * kStep);
  }

  Model model;
  std::vector<double> parameters;
  nn::Mask mask;
  std::optional<RolloutLeastSquares> problem;
  LossData<double> data;
  std::optional<RolloutLeastSquares::Workspace> workspace;
  VectorXd start, weights;
};

/// Compares the normal equations with those made of central differences.
void ExpectNormalEquationsMatch(Probe& probe) {
  const NormalEquations equations = probe.At(probe.parameters, probe.start);
  const Index unknowns = probe.problem->unknowns(), channels = probe.problem->channels();
  const MatrixXd predictions = probe.PredictionsAt(probe.parameters, probe.start);
  MatrixXd targets(channels, predictions.cols());
  const Index outputs = static_cast<Index>(probe.data.outputs.size()) / predictions.cols(), states = channels - outputs;
  if (states > 0) targets.topRows(states) = Eigen::Map<const MatrixXd>(probe.data.states.data(), states, predictions.cols());
  targets.bottomRows(outputs) = Eigen::Map<const MatrixXd>(probe.data.outputs.data(), outputs, predictions.cols());
  const MatrixXd residuals = predictions - targets;
  MatrixXd jacobian(predictions.size(), unknowns);
  for (Index i = 0; i < unknowns; ++i) jacobian.col(i) = probe.Slope(i).reshaped();
  const VectorXd weights = probe.weights.replicate(predictions.cols(), 1);
  const MatrixXd curvature = jacobian.transpose() * weights.asDiagonal() * jacobian;
  const VectorXd gradient = jacobian.transpose() * weights.asDiagonal() * residuals.reshaped();
  EXPECT_LT((equations.gradient - gradient).norm(), 1e-7 * (1 + gradient.norm()));
  const MatrixXd ours = equations.curvature.selfadjointView<Eigen::Lower>();
  EXPECT_LT((ours - curvature).norm(), 1e-7 * (1 + curvature.norm()));
  EXPECT_NEAR(equations.cost, 0.5 * residuals.reshaped().cwiseAbs2().dot(weights), 1e-12 * equations.cost);
  EXPECT_LT((equations.channel_squares - residuals.rowwise().squaredNorm()).norm(), 1e-12 * residuals.squaredNorm());
  EXPECT_NEAR(probe.problem->Cost(probe.parameters.data(), probe.start, probe.weights, probe.data, &*probe.workspace),
              equations.cost, 1e-12 * equations.cost);
}

TEST(LeastSquaresTest, NormalEquationsMatchCentralDifferencesForEveryKindOfModel) {
  for (const ModelCase& c : ModelCases()) {
    SCOPED_TRACE(c.name);
    for (const bool free_start : {false, true}) {
      if (free_start && !c.model.is_case_one()) continue;
      Probe probe(c, "*", free_start, 12, 1);
      ExpectNormalEquationsMatch(probe);
    }
  }
}

TEST(LeastSquaresTest, PiecesOfLongRolloutsAndManyRolloutsAddUp) {
  const ModelCase c = ModelCases().front();
  Probe one_long(c, "*", true, 150, 1);  // three pieces, the last one short
  ExpectNormalEquationsMatch(one_long);
  Probe many(c, "*", false, 150, 1);  // more rollouts than run side by side
  EXPECT_GT(many.data.shape.rollouts, 64);
  ExpectNormalEquationsMatch(many);
}

TEST(LeastSquaresTest, BendsMatchSecondDifferencesForEveryKindOfModel) {
  for (const ModelCase& c : ModelCases()) {
    SCOPED_TRACE(c.name);
    const bool free_start = c.model.is_case_one();
    Probe probe(c, "*", free_start, 12, 1);
    base::Rng rng(6);
    VectorXd direction(probe.problem->unknowns());
    for (double& value : direction) value = rng.Normal();
    const auto at = [&](double step) {
      std::vector<double> parameters = probe.parameters;
      const VectorXd adapted = step * direction.head(probe.problem->adapted_size());
      Index k = 0;
      for (const auto& [offset, size] : probe.problem->adapted()) {
        for (int64_t i = 0; i < size; ++i) parameters[static_cast<size_t>(offset + i)] += adapted[k++];
      }
      VectorXd start = probe.start;
      if (free_start) start += step * direction.tail(start.size());
      return std::pair(parameters, start);
    };
    constexpr double kWidth = 1e-4;
    const auto [up, start_up] = at(kWidth);
    const auto [down, start_down] = at(-kWidth);
    const MatrixXd second = (probe.PredictionsAt(up, start_up) + probe.PredictionsAt(down, start_down) -
                             2 * probe.PredictionsAt(probe.parameters, probe.start)) /
                            (kWidth * kWidth);
    VectorXd expected(direction.size());
    for (Index i = 0; i < expected.size(); ++i) {
      expected[i] = (probe.Slope(i).array() * (probe.weights.asDiagonal() * second).array()).sum();
    }
    probe.At(probe.parameters, probe.start);
    const auto bend = [&](const std::vector<double>& parameters, const VectorXd& start, double h) {
      return probe.problem->Bend(parameters.data(), start, h, direction, probe.weights, probe.data, &*probe.workspace);
    };
    const std::optional<VectorXd> forwards = bend(up, start_up, kWidth), backwards = bend(down, start_down, -kWidth);
    ASSERT_TRUE(forwards.has_value() && backwards.has_value());
    EXPECT_LT(((*forwards + *backwards) / 2 - expected).norm(), 1e-4 * expected.norm());  // the third derivative cancels
    const std::vector<double> nowhere(up.size(), std::numeric_limits<double>::quiet_NaN());
    EXPECT_FALSE(bend(nowhere, start_up, kWidth).has_value());
  }
}

TEST(LeastSquaresTest, AMaskPicksUnknowns) {
  const ModelCase c = ModelCases().front();
  Probe all(c, "*", false, 30, 2), some(c, "transition", false, 30, 2);
  const MatrixXd full = all.At(all.parameters, all.start).curvature.selfadjointView<Eigen::Lower>();
  const MatrixXd part = some.At(some.parameters, some.start).curvature.selfadjointView<Eigen::Lower>();
  std::vector<Index> picked;
  for (const auto& [offset, size] : some.problem->adapted()) {
    for (int64_t i = 0; i < size; ++i) picked.push_back(offset + i);
  }
  ASSERT_EQ(static_cast<Index>(picked.size()), part.rows());
  EXPECT_LT((full(picked, picked) - part).norm(), 1e-12 * part.norm());
}

TEST(LeastSquaresTest, CarriesAreWhatTheRolloutGoesThrough) {
  const ModelCase c = ModelCases().front();
  Probe probe(c, "*", true, 150, 1);
  const MatrixXd carries = probe.problem->Carries(probe.parameters.data(), probe.start, probe.data, &*probe.workspace);
  ASSERT_EQ(carries.cols(), 150);
  EXPECT_EQ(carries.col(0), probe.start);
  // A rollout from a later carry gives the rest of the predictions.
  Probe later(c, "*", true, 150, 1);
  const Index skipped = 70, n_u = probe.model.spec().input_size, n_y = probe.model.spec().output_size;
  later.data.inputs.erase(later.data.inputs.begin(), later.data.inputs.begin() + skipped * n_u);
  later.data.outputs.erase(later.data.outputs.begin(), later.data.outputs.begin() + skipped * n_y);
  later.data.shape.horizon -= static_cast<int32_t>(skipped);
  const MatrixXd whole = probe.PredictionsAt(probe.parameters, probe.start);
  const MatrixXd rest = later.PredictionsAt(probe.parameters, carries.col(skipped));
  EXPECT_LT((whole.rightCols(rest.cols()) - rest).norm(), 1e-12 * rest.norm());
}

TEST(LeastSquaresTest, ARolloutThatLeavesTheNumbersCostsInfinitelyMuch) {
  ModelCase c = ModelCases().front();
  c.model.transition.bypass = Bypass::kLinear;
  Probe probe(c, "*", true, 400, 1);
  for (double& value : probe.parameters) value *= 1e3;
  EXPECT_EQ(probe.problem->Cost(probe.parameters.data(), probe.start, probe.weights, probe.data, &*probe.workspace),
            std::numeric_limits<double>::infinity());
}

}  // namespace
}  // namespace metaekf::nssm
