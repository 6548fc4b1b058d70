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

/// The same objective under x ~ N(mean, precision⁻¹), whose residuals are straight: they do not bend it.
Objective Believed(const Objective& objective, const VectorXd& mean, const MatrixXd& precision) {
  const auto pulled = [&mean, &precision](const VectorXd& x) { return VectorXd(precision * (x - mean)); };
  return {.cost = [&objective, &mean, pulled](const VectorXd& x) { return objective.cost(x) + 0.5 * (x - mean).dot(pulled(x)); },
          .linearise =
              [&objective, &mean, &precision, pulled](const VectorXd& x, QuadraticModel* model) {
                objective.linearise(x, model);
                const VectorXd pull = pulled(x);
                model->cost += 0.5 * (x - mean).dot(pull);
                model->gradient += pull;
                model->curvature += precision;
              },
          .bend = objective.bend};
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
  NormalEquations equations;
  Objective of_data;  // linearised where the fit stands, and nowhere else
  of_data.cost = [&](const VectorXd& x) {
    place(x);
    return problem.Cost(all.data(), start, weights, data, workspace);
  };
  of_data.linearise = [&](const VectorXd& x, QuadraticModel* model) {
    place(x);
    problem.Linearise(all.data(), start, weights, data, workspace, &equations);
    *model = {.cost = equations.cost, .gradient = equations.gradient, .curvature = equations.curvature};
  };
  of_data.bend = [&](const VectorXd& x, const VectorXd& direction, double h) {
    place(x + h * direction);
    return problem.Bend(all.data(), start, h, direction, weights, data, workspace);
  };
  const std::optional<Directions>& directions = options.directions;
  const VectorXd mean = directions ? VectorXd::Zero(directions->basis.cols()) : belief.mean;
  const MatrixXd precision = (directions ? directions->precision : belief.precision).selfadjointView<Eigen::Lower>();
  const Objective along = directions ? Along(directions->basis, belief.mean, of_data) : of_data;
  const Objective objective = Believed(along, mean, precision);
  const auto unknowns_at = [&](const VectorXd& x) { return directions ? VectorXd(belief.mean + directions->basis * x) : x; };
  const OnIteration tell = [&](int iteration, double cost, const VectorXd& x) { return on_iteration(iteration, cost, unknowns_at(x)); };
  VectorXd x = directions ? CoordinatesNear(belief, directions->basis, from) : from;
  MapFit fit{.unknowns = from, .noise_variance = belief.noise_variance};
  LevenbergMarquardtOptions optimiser = options.optimiser;
  for (int round = 0; round < kNoiseRounds; ++round) {
    const LevenbergMarquardtResult result = MinimiseLevenbergMarquardt(objective, x, optimiser, on_iteration ? tell : OnIteration());
    optimiser.initial_damping = fit.damping = result.damping;
    x = result.x;
    fit.unknowns = unknowns_at(x);
    if (directions) fit.coordinates = x;
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
