#pragma once

#include <Eigen/Core>
#include <vector>

namespace metaekf::filter {

/// When a measurement is taken for an outlier.
struct GateOptions {
  /// Probability with which a right measurement passes: the gate opens up to NIS = χ² quantile of it. 0: every measurement passes.
  double probability = 1 - 1e-6;
  /// Samples in a row that may lose components; if the next would too, the filter is what is wrong: it is widened (WideningFor)
  /// and believes the measurement.
  int recover_after = 5;
};

/// The components that must be left out for the rest to pass: while ỹᵀS⁻¹ỹ of what is left exceeds its limit, the component
/// with the largest ỹᵢ²/Sᵢᵢ goes.
///
/// @param innovation  ỹ, m. @param innovation_cov  S, m × m, positive definite. @param limits  of 1 … m components.
std::vector<Eigen::Index> Outliers(const Eigen::VectorXd& innovation, const Eigen::MatrixXd& innovation_cov,
                                   const std::vector<double>& limits);

/// λ ≥ 1 with ỹᵀ (λ H P Hᵀ + R)⁻¹ ỹ = m: how many times P must be larger for ỹ to be what is expected of it; at most 10¹².
/// @param predicted_cov  H P Hᵀ, m × m. @param measurement_cov  R.
double WideningFor(const Eigen::VectorXd& innovation, const Eigen::MatrixXd& predicted_cov,
                   const Eigen::MatrixXd& measurement_cov);

}  // namespace metaekf::filter
