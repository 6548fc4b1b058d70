#pragma once

#include <nlohmann/json_fwd.hpp>

#include "absl/status/statusor.h"
#include "core/data/trajectory.h"

namespace metaekf::cli {

struct TrainingEstimate {
  double duration_s = 0;
  double memory_mib = 0;  ///< peak of the process that trains
};

/// What a training will take on this machine with all its processors, measured by doing a little of it: the duration is
/// right to a factor of two or so.
/// @param specification  JSON form of TrainingSpec.
/// Errors: those of meta::Train that show at once.
absl::StatusOr<TrainingEstimate> EstimateTraining(const nlohmann::json& specification, const data::Dataset& fleet);

}  // namespace metaekf::cli
