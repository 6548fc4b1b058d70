#pragma once

#include <vector>

#include "absl/status/statusor.h"
#include "core/base/executor.h"
#include "core/data/trajectory.h"
#include "core/meta/training_spec.h"
#include "core/meta/training_state.h"
#include "core/nssm/bundle.h"

namespace metaekf::meta {

/// A fleet in normalised units, split by system.
struct Systems {
  std::vector<data::Trajectory> training, validation;
};

/// The outer loop of the gradient-based algorithms (paper.tex algorithm alg:maml).
///
/// Each step draws `task_batch` systems, from each a context and a target set of consecutive samples anywhere in its
/// trajectory, independently; takes the mean of their meta-gradients, clips it and makes an Adam step. Held-out systems
/// judge the model every `validation_period` steps.
///
/// @return ω: the best on validation, the last if there is no validation.
/// Errors: Cancelled if on_step said so; OutOfRange when the training diverges, with the reason.
absl::StatusOr<std::vector<double>> RunOuterLoop(const TrainingSpec& spec, const nssm::Model& model,
                                                 const nn::Mask& mask, const Systems& systems, base::Executor* executor,
                                                 TrainingState* state, const OnTrainingStep& on_step);

}  // namespace metaekf::meta
