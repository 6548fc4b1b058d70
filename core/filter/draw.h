#pragma once

#include "core/base/rng.h"
#include "core/filter/ekf.h"

namespace metaekf::filter {

/// How things may stand, and how the samples to come may go on, a column each. Physical units.
struct Future {
  Eigen::VectorXd now;      ///< truth at the last sample
  Eigen::MatrixXd truth;    ///< of what the filter estimates: Case II x, Case I h(ψ)
  Eigen::MatrixXd outputs;  ///< y
};

/// A draw of what the filter takes to be possible: s ~ N(x⁺, P⁺), then s ← f(s, u) + w, y = h(s, u) + v (JointModel), whether states lie in the
/// model's set or not. What the filter makes of it is what it makes of a world that is as it believes: bounds that hold less there are no
/// fault of the model.
/// @param ekf  with an estimate. @param inputs  n_u × horizon, physical units.
/// Errors: FailedPrecondition where the filter has no estimate yet.
absl::StatusOr<Future> Draw(const Ekf& ekf, const Eigen::MatrixXd& inputs, base::Rng* rng, FilterModel::Scratch* scratch);

}  // namespace metaekf::filter
