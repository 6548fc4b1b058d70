#pragma once

#include "core/filter/joint_model.h"

namespace metaekf::filter {

/// What a filter of Case II begins with, from its first samples. Normalised units.
struct LeastSquaresProblem {
  Eigen::MatrixXd inputs, outputs;  ///< n_u × N, n_y × N; NaN in outputs: not measured
  bool next_input = false;          ///< f takes the input of the sample it leads to
  Eigen::VectorXd prior_mean;       ///< m of x₀ ~ N(m, L Lᵀ)
  Eigen::MatrixXd prior_factor;     ///< L
  Eigen::MatrixXd process_factor;   ///< Q^½
  Eigen::MatrixXd measurement_cov;  ///< R
};

struct StateEstimate {
  Eigen::VectorXd mean;
  Eigen::MatrixXd factor;  ///< lower triangle; covariance factor factorᵀ
};

/// The state at the last of N samples, from a filter that is linearised about the trajectory without process noise that explains
/// them best:
///
///   x̄: min over z of  |z|² + Σ_t |y_t − h(x̄_t, u_t)|²_{R⁻¹},   x̄₀ = m + L z,  x̄_{t+1} = f(x̄_t, u_t)
///
/// by Gauss–Newton's method, whose steps are halved until they help. An extended Kalman filter linearises about m first, and may
/// never come back from there if the state is far away; on a linear system both are the same.
/// @return NaN where no trajectory stays finite.
StateEstimate LeastSquaresStart(const JointModel& model, const LeastSquaresProblem& problem, FilterModel::Scratch* scratch);

}  // namespace metaekf::filter
