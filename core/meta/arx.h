#pragma once

#include <Eigen/Core>

#include "absl/status/statusor.h"
#include "core/data/trajectory.h"

namespace metaekf::meta {

/// A linear ARX model, the baseline beside every result:
///
///   y_t = c + Σ_{i=1…n} A_i y_{t−i} + Σ_{i=0…n} B_i u_{t−i}
///
/// fitted by least squares (one-step errors). Physical units throughout.
class ArxModel {
 public:
  static constexpr int kDefaultOrder = 5;

  /// Errors: FailedPrecondition if the trajectory has fewer samples than coefficients; InvalidArgument if a value
  /// is not finite.
  static absl::StatusOr<ArxModel> Fit(const data::Trajectory& trajectory, int order = kDefaultOrder);

  /// ŷ, n_y × T, from measured outputs, or from its own after the first `warmup` samples if `simulate`.
  /// The first max(order, warmup) columns are NaN.
  Eigen::MatrixXd Predict(const data::Trajectory& trajectory, bool simulate, Eigen::Index warmup) const;

  int order() const { return order_; }
  /// n_y × (1 + n n_y + (n + 1) n_u): c, A_1 … A_n, B_0 … B_n.
  const Eigen::MatrixXd& coefficients() const { return coefficients_; }

 private:
  Eigen::VectorXd Regressor(const Eigen::MatrixXd& inputs, const Eigen::MatrixXd& outputs, Eigen::Index t) const;

  int order_ = 0;
  Eigen::MatrixXd coefficients_;  // n_y × regressors
};

}  // namespace metaekf::meta
