#pragma once

#include <Eigen/Core>
#include <map>
#include <string>
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

struct LearnedStart {
  std::vector<double> parameters;              ///< ω
  std::map<std::string, double> tensor_rates;  ///< β by tensor, if they are learned
  Eigen::MatrixXd own;                         ///< of MIXED_EFFECTS: adapted parameters × training systems
};

/// The outer loop of the gradient-based algorithms (paper.tex algorithm alg:maml).
///
/// Each step draws `task_batch` systems, from each a context and a target set of consecutive samples anywhere in its
/// trajectory, independently; takes the mean of their meta-gradients, clips it and makes an Adam step. Held-out systems
/// judge the model every `validation_period` steps.
///
/// The state's "parameters" and "best_parameters" are the variables of MetaGradient: ω, then log β of every adapted tensor
/// if rates are learned. Both move by the same Adam step and count in the norm that is clipped.
///
/// MIXED_EFFECTS adds to these a δ_s of what adapts for every training system s, zero in the warm-up, and minimises
///
///   mean over s of  L(𝓣_s; ω + δ_s) + ½ λ |δ_s|²,     λ = inner_loop.proximal.
///
/// Dense Adam on δ, whose gradient is zero where a system is not drawn: rarely drawn effects take steps as large as the others'.
/// A held-out system has no δ, so nothing is judged and the last ω is the result, with the mean of δ_s in it.
///
/// A training diverges when a loss or gradient is no number, or the running mean of the loss is a million times what the
/// phase began with (and 1). The state then goes back to before the step that led there, and on_step hears of it once more.
///
/// Of several starts each goes through the first `screening_iterations`, the same tasks in the same order; the one with the
/// least validation loss then goes on as if it had been alone. A start that diverges has lost. The state counts all steps.
///
/// @return the best on validation, the last if there is no validation.
/// Errors: Cancelled if on_step said so; OutOfRange when the training diverges, with the reason; InvalidArgument if there are
/// several starts and no held-out systems.
absl::StatusOr<LearnedStart> RunOuterLoop(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask,
                                          const Systems& systems, base::Executor* executor, TrainingState* state,
                                          const OnTrainingStep& on_step);

}  // namespace metaekf::meta
