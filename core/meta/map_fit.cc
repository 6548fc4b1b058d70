#include "core/meta/map_fit.h"

#include <algorithm>
#include <cmath>

#include "core/linalg/decompositions.h"

namespace metaekf::meta {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using nssm::LossData;
using nssm::NormalEquations;
using nssm::RolloutLeastSquares;

namespace {

constexpr int kNoiseRounds = 4;           // of estimating the noise and fitting again, at most
constexpr double kNoiseConverged = 0.05;  // relative change that ends them

/// σ_c² from what the fit leaves, where γ of the unknowns are determined by the data.
/// @param precision  Λ of what the information is of.
VectorXd EstimateNoise(const VectorXd& start, const MatrixXd& precision, const MapFit& fit, int64_t samples, double noise_samples) {
  // γ = tr(I − (Λ + JᵀWJ)⁻¹ Λ)
  const linalg::Cholesky factor(fit.information);
  if (!factor.ok()) return start;  // where the fit stands says nothing
  const double undetermined = factor.Solve(precision).trace();
  const double determined = static_cast<double>(precision.rows()) - undetermined;
  const double used_channels = static_cast<double>((start.array() < std::numeric_limits<double>::infinity()).count());
  const double share = determined / std::max(1.0, used_channels);  // of each channel
  VectorXd variance = start;
  for (Index c = 0; c < start.size(); ++c) {
    if (!std::isfinite(start[c])) continue;
    const double freedom = std::max(1.0, static_cast<double>(samples) - share);
    variance[c] = (fit.channel_squares[c] + noise_samples * start[c]) / (freedom + noise_samples);
  }
  return variance;
}

/// The same objective as a function of z, of x = m + B z.
Objective Along(const MatrixXd& directions, const VectorXd& mean, const Objective& objective) {
  const auto at = [&directions, &mean](const VectorXd& z) { return VectorXd(mean + directions * z); };
  return {.cost = [&objective, at](const VectorXd& z) { return objective.cost(at(z)); },
          .linearise =
              [&objective, &directions, at](const VectorXd& z, QuadraticModel* model) {
                QuadraticModel of_x;
                objective.linearise(at(z), &of_x);
                model->cost = of_x.cost;
                model->gradient = directions.transpose() * of_x.gradient;
                model->curvature = directions.transpose() * (of_x.curvature.selfadjointView<Eigen::Lower>() * directions);
              },
          .bend = [&objective, &directions, at](const VectorXd& z, const VectorXd& direction, double h) -> std::optional<VectorXd> {
            const std::optional<VectorXd> bend = objective.bend(at(z), directions * direction, h);
            if (!bend) return std::nullopt;
            return directions.transpose() * *bend;
          }};
}

}  // namespace

VectorXd CoordinatesNear(const Belief& belief, const MatrixXd& directions, const VectorXd& x) {
  const MatrixXd weighted = belief.precision.selfadjointView<Eigen::Lower>() * directions;
  return linalg::Cholesky(directions.transpose() * weighted).Solve(VectorXd(weighted.transpose() * (x - belief.mean)));
}

void ScatterAdapted(const RolloutLeastSquares& problem, const VectorXd& unknowns, std::vector<double>* parameters) {
  Index from = 0;
  for (const auto& [offset, size] : problem.adapted()) {
    std::copy_n(unknowns.data() + from, size, parameters->data() + offset);
    from += size;
  }
}

VectorXd GatherAdapted(const RolloutLeastSquares& problem, const std::vector<double>& parameters) {
  VectorXd adapted(problem.adapted_size());
  Index to = 0;
  for (const auto& [offset, size] : problem.adapted()) {
    std::copy_n(parameters.data() + offset, size, adapted.data() + to);
    to += size;
  }
  return adapted;
}

MapFit FitMap(const RolloutLeastSquares& problem, const LossData<double>& data, const std::vector<double>& parameters,
              const Belief& belief, const VectorXd& from, const MapFitOptions& options,
              RolloutLeastSquares::Workspace* workspace, const OnIteration& on_iteration) {
  std::vector<double> all = parameters;
  VectorXd weights = belief.noise_variance.cwiseInverse();
  VectorXd start = VectorXd::Zero(problem.carry_size());
  const auto place = [&](const VectorXd& x) {
    ScatterAdapted(problem, x, &all);
    if (x.size() > problem.adapted_size()) start = x.tail(problem.carry_size());
  };
  const auto penalty = [&](const VectorXd& x) {
    const VectorXd d = x - belief.mean;
    return 0.5 * d.dot(belief.precision.selfadjointView<Eigen::Lower>() * d);
  };
  NormalEquations equations;
  Objective objective;  // linearised where the fit stands, and nowhere else
  objective.cost = [&](const VectorXd& x) {
    place(x);
    return problem.Cost(all.data(), start, weights, data, workspace) + penalty(x);
  };
  objective.linearise = [&](const VectorXd& x, QuadraticModel* model) {
    place(x);
    problem.Linearise(all.data(), start, weights, data, workspace, &equations);
    model->cost = equations.cost + penalty(x);
    model->gradient = equations.gradient + belief.precision.selfadjointView<Eigen::Lower>() * (x - belief.mean);
    model->curvature = equations.curvature + belief.precision;
  };
  objective.bend = [&](const VectorXd& x, const VectorXd& direction, double h) {  // the prior's residuals are straight
    place(x + h * direction);
    return problem.Bend(all.data(), start, h, direction, weights, data, workspace);
  };
  const bool all_free = options.directions.size() == 0;
  const MatrixXd& directions = options.directions;
  MatrixXd precision = belief.precision.selfadjointView<Eigen::Lower>();
  if (!all_free) precision = directions.transpose() * (precision * directions);
  const Objective along = Along(directions, belief.mean, objective);
  const OnIteration tell = [&](int iteration, double cost, const VectorXd& z) {
    return on_iteration(iteration, cost, all_free ? z : VectorXd(belief.mean + directions * z));
  };
  MapFit fit{.unknowns = from, .noise_variance = belief.noise_variance};
  if (!all_free) fit.coordinates = CoordinatesNear(belief, directions, from);
  LevenbergMarquardtOptions optimiser = options.optimiser;
  for (int round = 0; round < kNoiseRounds; ++round) {
    const LevenbergMarquardtResult result = MinimiseLevenbergMarquardt(
        all_free ? objective : along, all_free ? fit.unknowns : fit.coordinates, optimiser, on_iteration ? tell : OnIteration());
    optimiser.initial_damping = fit.damping = result.damping;
    (all_free ? fit.unknowns : fit.coordinates) = result.x;
    if (!all_free) fit.unknowns = belief.mean + directions * fit.coordinates;
    fit.information = result.model.curvature.selfadjointView<Eigen::Lower>();
    fit.channel_squares = equations.channel_squares;
    fit.cost = result.model.cost;
    fit.iterations += result.iterations;
    fit.converged = result.converged;
    fit.stopped = result.stopped;
    if (std::isinf(options.noise_samples) || result.stopped) break;
    const VectorXd before = fit.noise_variance;
    const int64_t samples = int64_t{data.shape.rollouts} * data.shape.horizon;
    fit.noise_variance = EstimateNoise(belief.noise_variance, precision, fit, samples, options.noise_samples);
    weights = fit.noise_variance.cwiseInverse();
    double change = 0;
    for (Index c = 0; c < before.size(); ++c) {
      if (std::isfinite(before[c])) change = std::max(change, std::fabs(fit.noise_variance[c] / before[c] - 1));
    }
    if (change < kNoiseConverged) break;
  }
  return fit;
}

}  // namespace metaekf::meta
