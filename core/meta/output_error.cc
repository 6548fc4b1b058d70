#include "core/meta/output_error.h"

#include <algorithm>
#include <complex>
#include <limits>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/linalg/decompositions.h"
#include "core/meta/arx.h"
#include "core/meta/levenberg_marquardt.h"

namespace metaekf::meta {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kLargestPole = 0.9999;  // of the start; on the circle errors of the start would never die away
constexpr LevenbergMarquardtOptions kOptimiser = {.max_iterations = 200, .tolerance = 1e-12};

/// One output's recursion over one recording: what stays the same while the coefficients change.
class Recursion {
 public:
  Recursion(const MatrixXd& inputs, int order) : inputs_(inputs), order_(order) {}

  Index coefficients() const { return 1 + order_ + (order_ + 1) * inputs_.rows(); }
  Index order() const { return order_; }
  Index length() const { return inputs_.cols(); }

  /// ŷ from its first `order` values.
  VectorXd Simulate(const VectorXd& coefficients, const VectorXd& initial) const {
    VectorXd output(length());
    output.head(order_) = initial;
    for (Index t = order_; t < length(); ++t) output[t] = coefficients.dot(Regressor(output, t));
    return output;
  }

  /// ∂ŷ/∂[coefficients; initial], T × unknowns:  s_t = ∂ŷ_t = φ_t − Σ f_i s_{t−i}.
  MatrixXd Sensitivity(const VectorXd& coefficients, const VectorXd& output) const {
    // As columns of samples: each is written and read as a whole.
    MatrixXd columns = MatrixXd::Zero(this->coefficients() + order_, length());
    columns.bottomLeftCorner(order_, order_).setIdentity();
    for (Index t = order_; t < length(); ++t) {
      columns.col(t).head(this->coefficients()) = Regressor(output, t);
      for (Index i = 1; i <= order_; ++i) columns.col(t) += coefficients[i] * columns.col(t - i);
    }
    return columns.transpose();
  }

  /// The initial values that fit the first `samples` measured outputs best: ŷ is affine in them.
  VectorXd FitInitial(const VectorXd& coefficients, const VectorXd& measured, Index samples) const {
    const Recursion head(inputs_.leftCols(samples), static_cast<int>(order_));
    const VectorXd forced = head.Simulate(coefficients, VectorXd::Zero(order_));
    const MatrixXd free = head.Sensitivity(coefficients, forced).rightCols(order_);
    return linalg::SolveLeastSquares(free, measured.head(samples) - forced);
  }

 private:
  VectorXd Regressor(const VectorXd& output, Index t) const {
    const Index n_u = inputs_.rows();
    VectorXd row(coefficients());
    row[0] = 1;
    for (Index i = 1; i <= order_; ++i) row[i] = output[t - i];
    for (Index i = 0; i <= order_; ++i) row.segment(1 + order_ + i * n_u, n_u) = inputs_.col(t - i);
    return row;
  }

  const MatrixXd inputs_;
  const Index order_;
};

/// The same polynomial 1 − Σ a_i z^{−i} with its roots inside the circle of radius kLargestPole.
VectorXd Stabilised(const VectorXd& past) {
  const Index n = past.size();
  MatrixXd companion = MatrixXd::Zero(n, n);
  companion.row(0) = past.transpose();
  companion.diagonal(-1).setOnes();
  Eigen::VectorXcd poles = linalg::Eigenvalues(companion);
  for (Index i = 0; i < n; ++i) {
    if (std::abs(poles[i]) > 1) poles[i] = 1.0 / std::conj(poles[i]);
    if (std::abs(poles[i]) > kLargestPole) poles[i] *= kLargestPole / std::abs(poles[i]);
  }
  Eigen::VectorXcd polynomial = Eigen::VectorXcd::Zero(n + 1);
  polynomial[0] = 1;
  for (Index i = 0; i < n; ++i) {
    for (Index k = i + 1; k >= 1; --k) polynomial[k] -= poles[i] * polynomial[k - 1];
  }
  return -polynomial.tail(n).real();
}

data::Trajectory OnlyOutput(const data::Trajectory& trajectory, Index output) {
  data::Trajectory single = trajectory;
  single.outputs = trajectory.outputs.row(output);
  return single;
}

/// Minimises ½ Σ (y − ŷ)² over [coefficients; initial], in units in which y and the inputs have a root mean square of one.
VectorXd Minimise(const Recursion& recursion, const VectorXd& measured, const VectorXd& start) {
  const Index p = recursion.coefficients();
  const auto simulate = [&](const VectorXd& x) { return recursion.Simulate(x.head(p), x.tail(recursion.order())); };
  const Objective objective = {
      .cost =
          [&](const VectorXd& x) {
            const double cost = 0.5 * (simulate(x) - measured).squaredNorm();
            return std::isfinite(cost) ? cost : std::numeric_limits<double>::infinity();
          },
      .linearise =
          [&](const VectorXd& x, QuadraticModel* model) {
            const VectorXd output = simulate(x), residuals = output - measured;
            const MatrixXd sensitivity = recursion.Sensitivity(x.head(p), output);
            model->cost = 0.5 * residuals.squaredNorm();
            model->gradient = sensitivity.transpose() * residuals;
            model->curvature = sensitivity.transpose() * sensitivity;
          }};
  return MinimiseLevenbergMarquardt(objective, start, kOptimiser, nullptr).x;
}

double RootMeanSquare(const MatrixXd& values) {
  const double mean_square = values.size() > 0 ? values.array().square().mean() : 0;
  return mean_square > 0 ? std::sqrt(mean_square) : 1;
}

}  // namespace

absl::StatusOr<OutputErrorModel> OutputErrorModel::Fit(const data::Trajectory& trajectory, int order) {
  if (order < 1) return absl::InvalidArgumentError(absl::StrCat("OE: the order is ", order, ", not positive"));
  OutputErrorModel model;
  model.order_ = order;
  // In units of one, so that the curvature of forces of 100 N and of displacements of 1e-4 m can be factored together.
  data::Trajectory scaled = trajectory;
  VectorXd input_scale(trajectory.inputs.rows());
  for (Index j = 0; j < input_scale.size(); ++j) {
    input_scale[j] = RootMeanSquare(trajectory.inputs.row(j));
    scaled.inputs.row(j) /= input_scale[j];
  }
  const Recursion recursion(scaled.inputs, order);
  const Index p = recursion.coefficients();
  if (trajectory.length() < p + 2 * order) {
    return absl::FailedPreconditionError(
        absl::StrCat("OE(", order, ") needs ", p + 2 * order, " samples, got ", trajectory.length()));
  }
  model.coefficients_.resize(trajectory.outputs.rows(), p);
  for (Index i = 0; i < trajectory.outputs.rows(); ++i) {
    const double scale = RootMeanSquare(trajectory.outputs.row(i));
    data::Trajectory single = OnlyOutput(scaled, i);
    single.outputs /= scale;
    METAEKF_ASSIGN_OR_RETURN(const ArxModel arx, ArxModel::Fit(single, order));
    const VectorXd measured = single.outputs.transpose();
    VectorXd start(p + order);
    start.head(p) = arx.coefficients().transpose();
    start.segment(1, order) = Stabilised(start.segment(1, order));
    start.tail(order) = recursion.FitInitial(start.head(p), measured, measured.size());
    VectorXd found = Minimise(recursion, measured, start).head(p);
    found[0] *= scale;
    for (Index k = 0; k < p - 1 - order; ++k) found[1 + order + k] *= scale / input_scale[k % input_scale.size()];
    model.coefficients_.row(i) = found.transpose();
  }
  return model;
}

MatrixXd OutputErrorModel::Predict(const data::Trajectory& trajectory, bool /*simulate*/, Index warmup) const {
  const Index start = std::min(std::max<Index>(order_, warmup), trajectory.length());
  MatrixXd prediction = MatrixXd::Constant(trajectory.outputs.rows(), trajectory.length(),
                                           std::numeric_limits<double>::quiet_NaN());
  if (start < order_ || start == trajectory.length()) return prediction;
  const Recursion recursion(trajectory.inputs, order_);
  for (Index i = 0; i < prediction.rows(); ++i) {
    const VectorXd coefficients = coefficients_.row(i);
    const VectorXd initial = recursion.FitInitial(coefficients, trajectory.outputs.row(i).transpose(), start);
    prediction.row(i).tail(trajectory.length() - start) =
        recursion.Simulate(coefficients, initial).tail(trajectory.length() - start).transpose();
  }
  return prediction;
}

}  // namespace metaekf::meta
