#pragma once

#include <Eigen/Core>
#include <functional>
#include <optional>

namespace metaekf::meta {

/// A sum of squares near one point: Φ(x + δ) ≈ cost + gradientᵀ δ + ½ δᵀ curvature δ.
struct QuadraticModel {
  double cost = 0;
  Eigen::VectorXd gradient;
  Eigen::MatrixXd curvature;  ///< symmetric, positive semidefinite; the lower triangle is read
};

/// What Levenberg–Marquardt minimises.
struct Objective {
  std::function<double(const Eigen::VectorXd&)> cost;  ///< may be infinite
  std::function<void(const Eigen::VectorXd&, QuadraticModel*)> linearise;
  /// Jᵀ d²r(x + s δ)/ds², by differences of width h in s, at the x of the last linearisation; nothing where it is unknown.
  /// May be empty.
  std::function<std::optional<Eigen::VectorXd>(const Eigen::VectorXd& x, const Eigen::VectorXd& direction, double h)> bend;
};

struct LevenbergMarquardtOptions {
  int max_iterations = 50;
  double tolerance = 1e-6;       ///< ends when steps keep bringing less than this share of Φ
  double initial_damping = 1;    ///< of the curvature's diagonal; less leaps out of the basin that the start is in
};

/// Called after every accepted step with its number, Φ and x; false stops.
using OnIteration = std::function<bool(int iteration, double cost, const Eigen::VectorXd& x)>;

struct LevenbergMarquardtResult {
  Eigen::VectorXd x;
  QuadraticModel model;  ///< at x
  int iterations = 0;    ///< linearisations after the first
  double damping = 0;    ///< for a minimisation that goes on from here
  bool converged = false;
  bool stopped = false;  ///< on_iteration said so
};

/// Minimises Φ by damped Gauss–Newton steps:
///
///   (B + μ D) δ = −g,   D = diag(B)
///
/// μ falls after steps that bring what the quadratic model promised and rises after those that do not
/// (K. Madsen, H. B. Nielsen, O. Tingleff, Methods for Non-Linear Least Squares Problems, 2004, section 3.2).
/// Where the objective says how its residuals bend, steps follow narrow curved valleys instead of falling out of them:
///
///   x ← x + δ + ½ a,   (B + μ D) a = −Jᵀ r″(δ, δ),
///
/// as long as the correction is small beside the step
/// (M. K. Transtrum, J. P. Sethna, Improvements to the Levenberg–Marquardt algorithm, arXiv:1201.5885, 2012).
///
/// @param on_iteration  may be empty.
LevenbergMarquardtResult MinimiseLevenbergMarquardt(const Objective& objective, const Eigen::VectorXd& x,
                                                    const LevenbergMarquardtOptions& options,
                                                    const OnIteration& on_iteration);

}  // namespace metaekf::meta
