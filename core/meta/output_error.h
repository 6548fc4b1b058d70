#pragma once

#include <Eigen/Core>
#include <vector>

#include "absl/status/statusor.h"
#include "core/data/trajectory.h"

namespace metaekf::meta {

/// A linear output-error model, one for every output: what a linear model can do where free run is what counts.
///
///   ŷ_t = c − Σ_{i=1…n} f_i ŷ_{t−i} + Σ_j Σ_{i=0…n} b_{j,i} u_{j,t−i},   y_t = ŷ_t + white noise
///
/// The coefficients and ŷ_0 … ŷ_{n−1} minimise Σ (y_t − ŷ_t)² by Levenberg–Marquardt from an ARX model, poles that are not
/// stable reflected into the unit circle. Derivatives of ŷ follow the recursion of ŷ itself, exactly. Physical units.
///
/// Source: L. Ljung, System Identification: Theory for the User, 1999, section 4.2.
class OutputErrorModel {
 public:
  static constexpr int kDefaultOrder = 5;

  /// Errors: FailedPrecondition if the trajectory has fewer samples than unknowns; InvalidArgument if a value is not finite
  /// or the order not positive.
  static absl::StatusOr<OutputErrorModel> Fit(const data::Trajectory& trajectory, int order = kDefaultOrder);

  /// ŷ, n_y × T, simulated from the initial values that fit the first max(order, warmup) outputs best. Those columns are
  /// NaN. White noise on the output leaves nothing to be gained from later measurements: one step ahead is no other.
  Eigen::MatrixXd Predict(const data::Trajectory& trajectory, bool simulate, Eigen::Index warmup) const;

  int order() const { return order_; }

 private:
  int order_ = 0;
  Eigen::MatrixXd coefficients_;  // n_y × (1 + n + (n + 1) n_u): c, −f, then b as ArxModel orders them
};

}  // namespace metaekf::meta
