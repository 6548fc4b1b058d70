#pragma once

#include "absl/status/statusor.h"
#include "core/base/executor.h"
#include "core/data/trajectory.h"
#include "core/meta/training_spec.h"
#include "core/meta/training_state.h"
#include "core/nssm/bundle.h"

namespace metaekf::meta {

/// Meta-trains a model on a fleet, by the algorithm that the specification names (RunOuterLoop, LearnGaussianPrior).
///
/// The normaliser is fitted to the training systems; default Q, R and initial covariance come from the residuals of
/// adapted models on the held-out ones.
///
/// The result depends on specification, data and seed alone, bit for bit: not on threads, nor on where it was
/// interrupted and resumed.
///
/// @param resume    nullptr, or the state to go on from.
/// @param on_step   called after every outer step; false stops the training.
/// Errors: InvalidArgument naming field or trajectory; FailedPrecondition if a trajectory is too short;
/// Cancelled if on_step said so; OutOfRange when the training diverges, with the reason.
absl::StatusOr<nssm::Bundle> Train(const TrainingSpec& spec, const data::Dataset& fleet, const TrainingState* resume,
                                   base::Executor* executor,
                                   const OnTrainingStep& on_step);

}  // namespace metaekf::meta
