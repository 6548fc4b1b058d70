#include "core/meta/levenberg_marquardt.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "core/linalg/decompositions.h"

namespace metaekf::meta {

using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kLargestDamping = 1e10;  // no step at all is left beyond it
// A step under much damping brings little far from the optimum too: it takes several in a row, with the damping falling, to
// say that there is no more to gain.
constexpr int kQuietSteps = 3;
constexpr double kBendWidth = 0.1;    // of the step: differences of residuals over it
constexpr double kLargestBend = 0.75;  // 2 |a| / |δ| in D's metric, beyond which the second order says nothing either
constexpr double kNothing = 1e-3;  // of the tolerance: a step that promises less is not worth taking

}  // namespace

LevenbergMarquardtResult MinimiseLevenbergMarquardt(const Objective& objective, const VectorXd& x,
                                                    const LevenbergMarquardtOptions& options,
                                                    const OnIteration& on_iteration) {
  LevenbergMarquardtResult result{.x = x};
  objective.linearise(result.x, &result.model);
  result.damping = options.initial_damping;
  double& damping = result.damping;
  double growth = 2;
  int quiet_steps = 0;
  while (result.iterations < options.max_iterations && damping < kLargestDamping) {
    const QuadraticModel& model = result.model;
    MatrixXd damped = model.curvature;
    // A direction in which nothing moves keeps its place: it needs a diagonal to be solved with.
    const double floor = 1e-12 * model.curvature.diagonal().maxCoeff();
    const VectorXd scale = model.curvature.diagonal().cwiseMax(floor);
    damped.diagonal() += damping * scale;
    const linalg::Cholesky factor(std::move(damped));
    if (!factor.ok()) {
      damping *= growth;
      growth *= 2;
      continue;
    }
    const VectorXd step = -factor.Solve(model.gradient);
    // Φ(x) − model(x + δ) = ½ δᵀ (μ D δ − g)
    const double promised = 0.5 * step.dot(damping * scale.cwiseProduct(step) - model.gradient);
    if (promised <= kNothing * options.tolerance * model.cost) {
      result.converged = true;
      break;
    }
    VectorXd next = result.x + step;
    if (objective.bend) {
      if (const std::optional<VectorXd> bend = objective.bend(result.x, step, kBendWidth)) {
        const VectorXd acceleration = -factor.Solve(*bend);
        const auto length = [&scale](const VectorXd& v) { return std::sqrt(v.cwiseAbs2().dot(scale)); };
        if (2 * length(acceleration) <= kLargestBend * length(step)) next += 0.5 * acceleration;
      }
    }
    const double cost = objective.cost(next);
    const double gained = model.cost - cost;
    if (!(gained > 0)) {  // not a number, or worse
      damping *= growth;
      growth *= 2;
      continue;
    }
    const double before = model.cost;
    result.x = next;
    objective.linearise(result.x, &result.model);
    ++result.iterations;
    const double ratio = gained / promised;
    damping *= std::max(1.0 / 3, 1 - std::pow(2 * ratio - 1, 3));
    growth = 2;
    if (on_iteration && !on_iteration(result.iterations, result.model.cost, result.x)) {
      result.stopped = true;
      break;
    }
    quiet_steps = gained <= options.tolerance * before ? quiet_steps + 1 : 0;
    if (quiet_steps == kQuietSteps) {
      result.converged = true;
      break;
    }
  }
  return result;
}

}  // namespace metaekf::meta
