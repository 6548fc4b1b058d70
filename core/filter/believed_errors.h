#pragma once

#include "core/base/rng.h"
#include "core/filter/ekf.h"

namespace metaekf::filter {

/// Errors that a filter would make along a run if it were right about them: draws of s − ŝ in the filter's own linear terms. What its bounds
/// hold of these is what chance makes of bounds that are right, errors lasting as they do.
///
///   e⁻ = √λ (F e⁺ + w)     e⁺ = A e⁻ + N(0, P⁺ − A P⁻ Aᵀ)     A = P⁺ (P⁻)⁻¹ = I − K H
///
/// with w ~ N(0, Q) and λ the widening of P⁻ (StepTrace): what is measured enters by what it makes of P⁻. Where the filter begins, or begins
/// anew, e⁺ ~ N(0, P⁺). Normalised units; sizes are those of the filter's state with what is beside it (JointModel).
class BelievedErrors {
 public:
  /// @param draws  that are followed side by side.
  BelievedErrors(int draws, base::Rng rng) : draws_(draws), rng_(rng) {}

  /// After a step of the filter. @param trace  of the step (Ekf::set_trace).
  void Follow(const Ekf& ekf, const StepTrace& trace);
  /// e⁺, a column each; empty before the filter has an estimate.
  const Eigen::MatrixXd& errors() const { return errors_; }

 private:
  Eigen::MatrixXd White(Eigen::Index rows);

  const int draws_;
  base::Rng rng_;
  Eigen::MatrixXd errors_, factor_;  // the factor of P⁺
};

}  // namespace metaekf::filter
