#include "core/filter/least_squares_start.h"

#include <Eigen/Cholesky>
#include <cmath>
#include <limits>
#include <vector>

#include "core/filter/square_root.h"

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr int kIterations = 50, kHalvings = 20;
constexpr double kSmallStep = 1e-8;

/// The model at one sample of a trajectory.
struct Point {
  VectorXd state, h;
  MatrixXd F, H;              // F of the step to the next
  std::vector<Index> rows;    // of y, that were measured
};

/// The trajectory from one x₀, with all that a step of Gauss and Newton needs.
struct Trajectory {
  std::vector<Point> points;
  double cost = std::numeric_limits<double>::infinity();  // without |z|²
  VectorXd gradient;  // of half the cost by x₀
  MatrixXd normal;    // Σ ΦᵀHᵀR⁻¹HΦ, Φ = ∂x_t/∂x₀
};

Trajectory Run(const JointModel& model, const LeastSquaresProblem& problem, const VectorXd& x0, FilterModel::Scratch* scratch) {
  const Index n = x0.size(), n_y = problem.outputs.rows(), steps = problem.outputs.cols();
  Trajectory run{.points = std::vector<Point>(static_cast<size_t>(steps)),
                 .cost = 0,
                 .gradient = VectorXd::Zero(n),
                 .normal = MatrixXd::Zero(n, n)};
  MatrixXd transfer = MatrixXd::Identity(n, n);
  VectorXd state = x0;
  for (Index t = 0; t < steps; ++t) {
    Point& point = run.points[static_cast<size_t>(t)];
    point = {.state = state, .h = VectorXd(n_y), .F = MatrixXd(n, n), .H = MatrixXd(n_y, n)};
    for (Index i = 0; i < n_y; ++i) {
      if (!std::isnan(problem.outputs(i, t))) point.rows.push_back(i);
    }
    model.Measurement(state, problem.inputs.col(t), &point.h, &point.H, scratch);
    if (!point.rows.empty()) {
      const VectorXd residual = (problem.outputs.col(t) - point.h)(point.rows);
      const MatrixXd J = point.H(point.rows, Eigen::all) * transfer;
      const Eigen::LLT<MatrixXd> R(MatrixXd(problem.measurement_cov(point.rows, point.rows)));
      const VectorXd weighted = R.solve(residual);
      run.cost += residual.dot(weighted);
      run.gradient -= J.transpose() * weighted;
      run.normal += J.transpose() * R.solve(J);
    }
    if (t + 1 == steps) break;
    VectorXd next(n);
    model.Transition(state, problem.inputs.col(problem.next_input ? t + 1 : t), &next, &point.F, scratch);
    state = next;
    transfer = point.F * transfer;
  }
  if (!std::isfinite(run.cost) || !state.allFinite()) run.cost = std::numeric_limits<double>::infinity();
  return run;
}

/// The Kalman filter of the system as it is linearised about a trajectory.
StateEstimate FilterAbout(const Trajectory& about, const LeastSquaresProblem& problem) {
  const Index n = problem.prior_mean.size();
  StateEstimate estimate{problem.prior_mean, problem.prior_factor};
  MatrixXd time_work(n, 2 * n);
  for (size_t t = 0; t < about.points.size(); ++t) {
    const Point& point = about.points[t];
    const Index m = static_cast<Index>(point.rows.size());
    if (m > 0) {
      MatrixXd work(m + n, m + n);
      work.topLeftCorner(m, m) =
          MatrixXd(Eigen::LLT<MatrixXd>(MatrixXd(problem.measurement_cov(point.rows, point.rows))).matrixL());
      const MatrixXd H = point.H(point.rows, Eigen::all);
      const VectorXd expected = point.h + point.H * (estimate.mean - point.state);
      const VectorXd innovation = (problem.outputs.col(static_cast<Index>(t)) - expected)(point.rows);
      FactorMeasurementUpdate(H, work, &estimate.factor);
      const auto root = work.topLeftCorner(m, m).triangularView<Eigen::Lower>();
      estimate.mean += work.bottomLeftCorner(n, m) * root.solve(innovation);
    }
    if (t + 1 == about.points.size()) break;
    FactorTimeUpdate(point.F, problem.process_factor, &time_work, &estimate.factor);
    estimate.mean = about.points[t + 1].state + point.F * (estimate.mean - point.state);
  }
  return estimate;
}

}  // namespace

StateEstimate LeastSquaresStart(const JointModel& model, const LeastSquaresProblem& problem, FilterModel::Scratch* scratch) {
  const Index n = problem.prior_mean.size();
  const MatrixXd& L = problem.prior_factor;
  VectorXd z = VectorXd::Zero(n);
  const auto run_from = [&](const VectorXd& at) { return Run(model, problem, problem.prior_mean + L * at, scratch); };
  Trajectory best = run_from(z);
  for (int iteration = 0; iteration < kIterations && std::isfinite(best.cost); ++iteration) {
    const MatrixXd information = MatrixXd::Identity(n, n) + L.transpose() * best.normal * L;
    VectorXd step = -information.llt().solve(z + L.transpose() * best.gradient);
    bool better = false;
    for (int halving = 0; halving < kHalvings && !better; ++halving, step /= 2) {
      const Trajectory trial = run_from(z + step);
      better = trial.cost + (z + step).squaredNorm() < best.cost + z.squaredNorm();
      if (!better) continue;
      z += step;
      best = trial;
      break;
    }
    if (!better || step.norm() < kSmallStep * (1 + z.norm())) break;
  }
  if (!std::isfinite(best.cost)) {
    constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
    return {VectorXd::Constant(n, kNaN), MatrixXd::Constant(n, n, kNaN)};
  }
  return FilterAbout(best, problem);
}

}  // namespace metaekf::filter
