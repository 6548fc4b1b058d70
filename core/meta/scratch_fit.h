#pragma once

#include "core/base/executor.h"
#include "core/meta/fit_plan.h"

namespace metaekf::meta {

struct FromScratchOptions {
  uint64_t seed = 0;
  int32_t restarts = 6;
  int32_t steps = 60;
  /// Holds the recording's tail out, to see where on the way to the minimum it is predicted best, and from which start.
  bool stop_early = false;
  base::Executor* executor = base::CallingThread();  ///< runs the starts
};

/// Fits a system of which nothing is known: the best of several starts, each a linear model of the recording (LinearStart)
/// where the model has the form for it, else random. Rollouts from measured or encoded starts grow to their full length.
/// Residuals count as the loss weighs them; the noise variance that comes out is theirs.
///
/// At the minimum a model of a hundred parameters has learned the noise of some hundred samples. Stopping early, the last
/// fifth is held out: what predicts it best on the way of all starts is the result, unless the end of that way is nearly as
/// good; then the fit goes on to the minimum of the whole recording.
///
/// @param on_step  called by one thread at a time; false stops all fits, with the best so far.
/// Errors: FailedPrecondition if the recording is too short; OutOfRange if no start gives a finite cost.
absl::StatusOr<SystemFit> FitFromScratch(const FitPlan& plan, const nssm::Model& model, const nssm::LossSpec& loss,
                                         const data::Trajectory& normalised, const FromScratchOptions& options,
                                         const OnFitStep& on_step);

}  // namespace metaekf::meta
