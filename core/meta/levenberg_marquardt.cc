#include "core/meta/levenberg_marquardt.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

namespace metaekf::meta {

using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kLargestDamping = 1e10;  // no step at all is left beyond it

}  // namespace

LevenbergMarquardtResult MinimiseLevenbergMarquardt(const Objective& objective, const VectorXd& x,
                                                    const LevenbergMarquardtOptions& options,
                                                    const std::function<bool(int, double)>& on_iteration) {
  LevenbergMarquardtResult result{.x = x};
  objective.linearise(result.x, &result.model);
  double damping = options.initial_damping, growth = 2;
  while (result.iterations < options.max_iterations && damping < kLargestDamping) {
    const QuadraticModel& model = result.model;
    MatrixXd damped = model.curvature;
    // A direction in which nothing moves keeps its place: it needs a diagonal to be solved with.
    const double floor = 1e-12 * model.curvature.diagonal().maxCoeff();
    const VectorXd scale = model.curvature.diagonal().cwiseMax(floor);
    damped.diagonal() += damping * scale;
    const Eigen::LLT<MatrixXd> factor(damped);
    if (factor.info() != Eigen::Success) {
      damping *= growth;
      growth *= 2;
      continue;
    }
    const VectorXd step = -factor.solve(model.gradient);
    // Φ(x) − model(x + δ) = ½ δᵀ (μ D δ − g)
    const double promised = 0.5 * step.dot(damping * scale.cwiseProduct(step) - model.gradient);
    if (promised <= options.tolerance * model.cost) {
      result.converged = true;
      break;
    }
    const VectorXd next = result.x + step;
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
    if (on_iteration && !on_iteration(result.iterations, result.model.cost)) {
      result.stopped = true;
      break;
    }
    if (gained <= options.tolerance * before) {
      result.converged = true;
      break;
    }
  }
  return result;
}

}  // namespace metaekf::meta
