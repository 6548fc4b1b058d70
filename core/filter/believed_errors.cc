#include "core/filter/believed_errors.h"

#include <Eigen/Cholesky>

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kJitter = 1e-12;  // of a correlation matrix: directions of which nothing is unknown have no error either

/// M with M Mᵀ = `cov`, which may be singular, and by rounding a little less than that.
MatrixXd SquareRoot(const MatrixXd& cov) {
  const Eigen::LDLT<MatrixXd> ldlt(cov);
  const MatrixXd lower = MatrixXd(ldlt.matrixL()) * ldlt.vectorD().cwiseMax(0).cwiseSqrt().asDiagonal();
  return ldlt.transpositionsP().transpose() * lower;
}

/// P⁻¹ of a covariance matrix that may be singular.
MatrixXd Inverse(const MatrixXd& P) {
  const VectorXd scale = (P.diagonal().array() > 0).select(P.diagonal().cwiseSqrt().cwiseInverse(), 0);
  MatrixXd correlation = scale.asDiagonal() * P * scale.asDiagonal();
  correlation.diagonal().array() += kJitter;
  for (Index i = 0; i < scale.size(); ++i) {
    if (scale[i] == 0) correlation(i, i) = 1;
  }
  return scale.asDiagonal() * MatrixXd(correlation.ldlt().solve(MatrixXd::Identity(scale.size(), scale.size()))) * scale.asDiagonal();
}

}  // namespace

MatrixXd BelievedErrors::White(Index rows) {
  MatrixXd white(rows, draws_);
  for (double& value : white.reshaped()) value = rng_.Normal();
  return white;
}

void BelievedErrors::Follow(const Ekf& ekf, const StepTrace& trace) {
  const MatrixXd& factor = ekf.state().factor;
  if (trace.warming_up) {
    errors_.resize(0, 0);
    return;
  }
  if (!trace.linked || errors_.size() == 0) {
    errors_ = factor * White(factor.cols());
  } else {
    const MatrixXd& Q = ekf.process_factor();
    const MatrixXd moved = trace.F * factor_;
    const MatrixXd prior = trace.widening * (moved * moved.transpose() + Q * Q.transpose());
    const MatrixXd posterior = factor * factor.transpose();
    const MatrixXd A = posterior * Inverse(prior);
    const MatrixXd e = std::sqrt(trace.widening) * (trace.F * errors_ + Q * White(Q.cols()));
    errors_ = A * e + SquareRoot(posterior - A * prior * A.transpose()) * White(factor.rows());
  }
  factor_ = factor;
}

}  // namespace metaekf::filter
