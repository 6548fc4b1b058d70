#pragma once

#include <functional>
#include <map>
#include <string>
#include <vector>

#include "absl/status/statusor.h"

namespace metaekf::meta {

/// Where a training stands: everything that it needs to go on as if it had never stopped.
struct TrainingState {
  int32_t iteration = 0;            ///< outer steps, or systems fitted
  double best_validation_loss = 0;  ///< infinite before the first validation
  double validation_loss = 0;       ///< the latest
  double training_loss = 0;
  /// What the algorithm goes on from, by names of its own: ω, moments, fits, …
  std::map<std::string, std::vector<double>> values;
};

/// A TrainingState as bytes, with a digest of the specification and data it belongs to, and back.
/// Errors: InvalidArgument if the bytes are damaged or belong to another training.
std::string WriteCheckpoint(const TrainingState& state, const std::string& training_digest);
absl::StatusOr<TrainingState> ReadCheckpoint(const std::string& bytes, const std::string& training_digest);

/// What the caller of a training sees of it.
struct TrainingProgress {
  const TrainingState& state;
  int32_t iterations = 0;
  bool validated = false;  ///< a validation has just been made
  bool diverged = false;   ///< the training ends here; the state is the last good one
};

/// False stops the training.
using OnTrainingStep = std::function<bool(const TrainingProgress&)>;

}  // namespace metaekf::meta
