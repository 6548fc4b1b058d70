#pragma once

#include <functional>
#include <string>

#include "absl/status/statusor.h"
#include "core/data/trajectory.h"
#include "core/experiments/learner.h"

namespace metaekf::experiments {

/// A classical way to model a system from its context alone, of outputs in free run and one step ahead.
struct ClassicalModel {
  std::string label;
  /// Errors: those of the fit (FailedPrecondition if the context is too short for the order).
  std::function<absl::StatusOr<SystemModel>(const data::Trajectory& context)> fit;
};

ClassicalModel Arx(int order);
ClassicalModel OutputError(int order);
ClassicalModel PolynomialNarx(int order, int degree);

}  // namespace metaekf::experiments
