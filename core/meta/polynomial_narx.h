#pragma once

#include <Eigen/Core>
#include <vector>

#include "absl/status/statusor.h"
#include "core/data/trajectory.h"

namespace metaekf::meta {

/// A polynomial NARX model: of all classical nonlinear models the plainest.
///
///   v = [y_{t−1}; …; y_{t−n}; u_t; …; u_{t−n}],   ŷ_t = Σ_m θ_m v^m,   over all monomials v^m of degree 0 … d
///
/// v and the monomials are standardised, θ is found by ridge regression of the one-step errors with a weight that rounding
/// needs and no more. Physical units throughout.
///
/// Source: S. A. Billings, Nonlinear System Identification, 2013, section 2.2.
class PolynomialNarxModel {
 public:
  static constexpr int kMostTerms = 2000;

  /// Errors: InvalidArgument if order or degree is not positive, there would be more than kMostTerms monomials, or a value
  /// is not finite; FailedPrecondition if there are fewer samples than monomials.
  static absl::StatusOr<PolynomialNarxModel> Fit(const data::Trajectory& trajectory, int order, int degree);

  /// ŷ, n_y × T, from measured outputs, or from its own after the first `warmup` samples if `simulate`. The first
  /// max(order, warmup) columns are NaN. A free run that leaves the data by far has diverged: infinite from there on.
  Eigen::MatrixXd Predict(const data::Trajectory& trajectory, bool simulate, Eigen::Index warmup) const;

  int order() const { return order_; }
  Eigen::Index terms() const { return coefficients_.cols(); }

 private:
  /// v at t, standardised.
  Eigen::VectorXd Regressor(const Eigen::MatrixXd& inputs, const Eigen::MatrixXd& outputs, Eigen::Index t) const;
  /// All monomials of v, the constant first.
  Eigen::VectorXd Monomials(const Eigen::VectorXd& regressor) const;

  int order_ = 0;
  std::vector<std::pair<Eigen::Index, Eigen::Index>> products_;  // monomial k + 1 = monomial first · v[second]
  Eigen::VectorXd mean_, scale_;                                 // of v
  Eigen::MatrixXd coefficients_;                                 // n_y × monomials
};

}  // namespace metaekf::meta
