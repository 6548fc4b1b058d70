#pragma once

#include <Eigen/Core>

#include "absl/status/statusor.h"

namespace metaekf::filter {

/// Makes A lower triangular by Householder reflections from the right, A ← A Θ with Θ orthogonal: afterwards A = [L 0] with
/// L Lᵀ = A Aᵀ and a non-negative diagonal. In place, no allocation.
///
/// @param a  m × n with m ≤ n.
void LowerTriangularise(Eigen::Ref<Eigen::MatrixXd> a);

/// L with L Lᵀ = A for a symmetric positive semidefinite A.
/// Errors: InvalidArgument if A is not square, symmetric and positive semidefinite to rounding.
absl::StatusOr<Eigen::MatrixXd> SemidefiniteFactor(const Eigen::MatrixXd& a);

/// The time update of a covariance factor, P⁻ = F P⁺ Fᵀ + Q:
///
///   [F L⁺  Q^½] Θ = [L⁻  0]
///
/// @param F  n × n. @param process_factor  Q^½, n × n. @param work  n × 2n of scratch.
/// @param factor  L⁺ in, L⁻ out, n × n, lower triangles.
void FactorTimeUpdate(const Eigen::MatrixXd& F, const Eigen::MatrixXd& process_factor, Eigen::MatrixXd* work,
                      Eigen::MatrixXd* factor);

/// The measurement update of a covariance factor with m measured components:
///
///   [R^½  H L⁻]     [S^½    0 ]
///   [ 0    L⁻ ] Θ = [K S^½  L⁺]
///
/// @param work  (m + n) × (m + n); its upper left m × m holds R^½ and the block below and beside it is written.
///              On return its first m columns are [S^½; K S^½].
/// @param H_rows  m × n. @param factor  L⁻ in, L⁺ out, n × n, lower triangles.
void FactorMeasurementUpdate(const Eigen::Ref<const Eigen::MatrixXd>& H_rows, Eigen::Ref<Eigen::MatrixXd> work,
                             Eigen::MatrixXd* factor);

}  // namespace metaekf::filter
