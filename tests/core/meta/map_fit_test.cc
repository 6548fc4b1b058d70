#include "core/meta/map_fit.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/QR>

#include "core/base/rng.h"
#include "tests/core/nssm/random_models.h"

namespace metaekf::meta {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using nssm::LossData;
using nssm::LossSpec;
using nssm::Model;
using nssm::ModelSpec;
using nssm::RolloutLeastSquares;

/// A linear Case I model whose output decoder alone is unknown: ŷ = W ψ + b with ψ known, a linear regression.
struct Regression {
  Regression() : model(*Model::Create(Spec())), parameters(nssm::RandomParameters(model, 3)) {
    LossSpec loss{.horizon = LossSpec::kWholeSet, .state_weight = 0, .reconstruction_weight = 0};
    problem.emplace(model, loss, *nn::ParseMask("output_decoder", model.layout()), false);
    data = *problem->Cut(nssm::RandomTrajectory(model.spec(), 60, 8));
    workspace.emplace(*problem, data.shape);
    const Index n = problem->unknowns();
    belief.mean = VectorXd::LinSpaced(n, -1, 1);
    const MatrixXd root = MatrixXd::Identity(n, n) + 0.1 * MatrixXd::Ones(n, n);
    belief.precision = root * root.transpose();
    belief.noise_variance = Eigen::Vector2d(0.5, 2);
    // The design matrix by the definition: predictions are linear in the unknowns.
    const auto predictions = [&](const VectorXd& unknowns) -> VectorXd {
      std::vector<double> p = parameters;
      ScatterAdapted(*problem, unknowns, &p);
      return problem->Predictions(p.data(), VectorXd(), data, &*workspace).reshaped();
    };
    const VectorXd at_zero = predictions(VectorXd::Zero(n));
    design.resize(at_zero.size(), n);
    for (Index i = 0; i < n; ++i) design.col(i) = predictions(VectorXd::Unit(n, i)) - at_zero;
    target = Eigen::Map<const VectorXd>(data.outputs.data(), at_zero.size()) - at_zero;
  }

  static ModelSpec Spec() {
    ModelSpec spec = nssm::ModelCases().front().model;
    spec.output_decoder.hidden_widths.clear();
    return spec;
  }
  MapFit Fit(const MapFitOptions& options = {.optimiser = {.max_iterations = 100, .tolerance = 1e-15}}) {
    return FitMap(*problem, data, parameters, belief, belief.mean, options, &*workspace);
  }

  Model model;
  std::vector<double> parameters;
  std::optional<RolloutLeastSquares> problem;
  LossData<double> data;
  std::optional<RolloutLeastSquares::Workspace> workspace;
  Belief belief;
  MatrixXd design;
  VectorXd target;
};

TEST(MapFitTest, ALinearModelsPosteriorIsBayesianLinearRegressions) {
  Regression r;
  const VectorXd weights = r.belief.noise_variance.cwiseInverse().replicate(r.design.rows() / 2, 1);
  const MatrixXd information = r.belief.precision + r.design.transpose() * weights.asDiagonal() * r.design;
  const VectorXd mean =
      information.llt().solve(r.belief.precision * r.belief.mean + r.design.transpose() * weights.cwiseProduct(r.target));
  const MapFit fit = r.Fit();
  EXPECT_LT((fit.unknowns - mean).norm(), 1e-6 * mean.norm());
  EXPECT_LT((fit.information - information).norm(), 1e-10 * information.norm());
}

// θ = m + B z with z ~ N(0, Λ_z⁻¹): a Bayesian regression on the columns of X B.
TEST(MapFitTest, AlongDirectionsItIsTheRegressionOnThem) {
  Regression r;
  const Index n = r.problem->unknowns();
  const MatrixXd directions = MatrixXd::Random(n, 3), precision = Eigen::Vector3d(1, 2, 5).asDiagonal();
  const VectorXd weights = r.belief.noise_variance.cwiseInverse().replicate(r.design.rows() / 2, 1);
  const MatrixXd design = r.design * directions;
  const MatrixXd information =
      precision + design.transpose() * weights.asDiagonal() * design;
  const VectorXd z = information.llt().solve(design.transpose() * weights.cwiseProduct(r.target - r.design * r.belief.mean));
  const MapFit fit = r.Fit({.optimiser = {.max_iterations = 100, .tolerance = 1e-15}, .directions = Directions{directions, precision}});
  EXPECT_LT((fit.coordinates - z).norm(), 1e-6 * z.norm());
  EXPECT_LT((fit.unknowns - r.belief.mean - directions * z).norm(), 1e-6 * fit.unknowns.norm());
  EXPECT_LT((fit.information - information).norm(), 1e-10 * information.norm());
}

TEST(MapFitTest, AlongAllDirectionsItIsTheFreeFit) {
  Regression r;
  const MatrixXd all = MatrixXd::Identity(r.problem->unknowns(), r.problem->unknowns());
  const MapFitOptions options{.optimiser = {.max_iterations = 100, .tolerance = 1e-15}, .noise_samples = 5};
  MapFitOptions along = options;
  along.directions = {all, r.belief.precision};
  const MapFit free = r.Fit(options), restricted = r.Fit(along);
  // A cost that is known to 1e-15 leaves the minimiser known to the root of that.
  EXPECT_LT((free.unknowns - restricted.unknowns).norm(), 3e-8 * free.unknowns.norm());
  EXPECT_LT((free.noise_variance - restricted.noise_variance).norm(), 1e-9);
}

TEST(MapFitTest, CoordinatesNearArePreciselyThoseOfWhatLiesOnTheDirections) {
  Regression r;
  const MatrixXd directions = MatrixXd::Random(r.problem->unknowns(), 3);
  const VectorXd z = VectorXd::Random(3);
  EXPECT_LT((CoordinatesNear(r.belief, directions, r.belief.mean + directions * z) - z).norm(), 1e-12);
  // What is orthogonal to them in the belief's metric is not seen.
  const MatrixXd weighted = r.belief.precision * directions;
  const VectorXd orthogonal = weighted.householderQr().householderQ() * VectorXd::Unit(weighted.rows(), 3);
  EXPECT_LT(CoordinatesNear(r.belief, directions, r.belief.mean + orthogonal).norm(), 1e-12);
}

TEST(MapFitTest, AnInfinitelySureBeliefStays) {
  Regression r;
  r.belief.precision *= 1e14;
  EXPECT_LT((r.Fit().unknowns - r.belief.mean).norm(), 1e-9);
}

TEST(MapFitTest, AChannelWithoutWeightIsNotLookedAt) {
  Regression r;
  r.belief.noise_variance[1] = std::numeric_limits<double>::infinity();
  const VectorXd with_one = r.Fit().unknowns;
  for (size_t i = 1; i < r.data.outputs.size(); i += 2) r.data.outputs[i] = 1e3;
  EXPECT_EQ(r.Fit().unknowns, with_one);
}

TEST(MapFitTest, NoiseIsEstimatedFromWhatTheFitLeaves) {
  Regression r;
  // Targets of known noise: half of what is believed of channel 0, five times that of channel 1.
  base::Rng rng(2);
  const VectorXd truth = VectorXd::Constant(r.problem->unknowns(), 0.3);
  r.belief.mean = truth;
  const VectorXd sigma = Eigen::Vector2d(0.5, 3);
  std::vector<double> p = r.parameters;
  ScatterAdapted(*r.problem, truth, &p);
  const MatrixXd clean = r.problem->Predictions(p.data(), VectorXd(), r.data, &*r.workspace);
  for (Index i = 0; i < clean.size(); ++i) r.data.outputs[static_cast<size_t>(i)] = clean.data()[i] + sigma[i % 2] * rng.Normal();

  const MatrixXd noise = Eigen::Map<const MatrixXd>(r.data.outputs.data(), 2, clean.cols()) - clean;
  const VectorXd drawn = noise.rowwise().norm() / std::sqrt(static_cast<double>(noise.cols()));
  const MapFit fit = r.Fit({.optimiser = {.max_iterations = 100, .tolerance = 1e-12}, .noise_samples = 1});
  for (Index c = 0; c < 2; ++c) EXPECT_NEAR(std::sqrt(fit.noise_variance[c]), drawn[c], 0.05 * drawn[c]);
}

TEST(MapFitTest, ScatterAndGatherAreInverse) {
  Regression r;
  const VectorXd values = VectorXd::LinSpaced(r.problem->unknowns(), 1, 2);
  std::vector<double> p = r.parameters;
  ScatterAdapted(*r.problem, values, &p);
  EXPECT_EQ(GatherAdapted(*r.problem, p), values);
}

}  // namespace
}  // namespace metaekf::meta
