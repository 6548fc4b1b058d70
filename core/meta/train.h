#pragma once

#include <functional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/executor.h"
#include "core/data/trajectory.h"
#include "core/meta/training_spec.h"
#include "core/nssm/bundle.h"

namespace metaekf::meta {

/// Where an outer loop stands: everything that it needs to go on as if it had never stopped.
struct TrainingState {
  int32_t iteration = 0;                ///< outer steps done
  std::vector<double> parameters;       ///< ω
  std::vector<double> first_moment;     ///< of Adam
  std::vector<double> second_moment;
  std::vector<double> best_parameters;  ///< of the lowest validation loss so far
  double best_validation_loss = 0;      ///< infinite before the first validation
  double validation_loss = 0;           ///< the latest
  double training_loss = 0;             ///< recent mean of the target losses
};

/// A TrainingState as bytes, with a digest of the specification and data it belongs to, and back.
/// Errors: InvalidArgument if the bytes are damaged or belong to another training.
std::string WriteCheckpoint(const TrainingState& state, const std::string& training_digest);
absl::StatusOr<TrainingState> ReadCheckpoint(const std::string& bytes, const std::string& training_digest);

/// What the caller of Train sees of every outer step.
struct TrainingProgress {
  const TrainingState& state;
  int32_t iterations = 0;
  bool validated = false;  ///< a validation has just been made
};

/// Meta-trains a model on a fleet (paper.tex algorithm alg:maml).
///
/// Each outer step draws `task_batch` systems, from each a context and a target set of consecutive samples
/// anywhere in its trajectory, independently; takes the mean of their meta-gradients, clips it and makes an Adam step.
/// Held-out systems judge the model every `validation_period` steps; the best one is returned, with the normaliser
/// fitted to the training systems and default Q, R and initial covariance from the residuals of adapted models on the
/// held-out ones.
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
                                   const std::function<bool(const TrainingProgress&)>& on_step);

}  // namespace metaekf::meta
