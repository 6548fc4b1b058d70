#pragma once

#include <Eigen/Core>

namespace metaekf::linalg {

// Dense decompositions of matrices of some hundred rows, by LAPACK, which picks its kernels for the processor at run time.
// Eigen's own would be compiled anew, for the least of processors, in every source that uses them. Where an iteration of
// LAPACK does not come to its end, as on matrices with NaN, values are NaN.

/// A = L Lᵀ of a symmetric positive definite A, of which the lower triangle is read.
class Cholesky {
 public:
  explicit Cholesky(Eigen::MatrixXd a);

  /// Whether A is positive definite, as far as rounding lets it be told; nothing else may be called if it is not.
  bool ok() const { return ok_; }
  /// A⁻¹ B, of a B with as many rows as A.
  Eigen::MatrixXd Solve(Eigen::MatrixXd b) const;
  Eigen::VectorXd Solve(Eigen::VectorXd b) const;
  /// A⁻¹, both triangles.
  Eigen::MatrixXd Inverse() const;

 private:
  void SolveInPlace(Eigen::Index columns, double* b) const;

  Eigen::MatrixXd lower_;  // what stands above the diagonal means nothing
  bool ok_;
};

/// A = U diag(σ) Vᵀ with σ₁ ≥ σ₂ ≥ …; U is m × k, V n × k, k the lesser of m and n.
struct SingularValues {
  Eigen::MatrixXd u;
  Eigen::VectorXd values;
  Eigen::MatrixXd v;
};
SingularValues DecomposeSingularValues(Eigen::MatrixXd a);

/// A = V diag(λ) Vᵀ of a symmetric A, of which the lower triangle is read; λ₁ ≤ λ₂ ≤ ….
struct SymmetricEigen {
  Eigen::VectorXd values;
  Eigen::MatrixXd vectors;
};
SymmetricEigen DecomposeSymmetric(Eigen::MatrixXd a);

/// Eigenvalues of a square matrix, in no order.
Eigen::VectorXcd Eigenvalues(Eigen::MatrixXd a);

/// The X of least norm that minimises |A X − B|, A of any shape and rank.
Eigen::MatrixXd SolveLeastSquares(Eigen::MatrixXd a, const Eigen::MatrixXd& b);

}  // namespace metaekf::linalg
