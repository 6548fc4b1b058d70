#pragma once

#include <string>
#include <string_view>

#include "absl/status/statusor.h"
#include "core/data/trajectory.h"
#include "core/meta/training_spec.h"
#include "metaekf/v1/training.pb.h"

namespace metaekf::server {

/// What a training needs in one file: the messages of the CreateTrainingJob call, header first,
/// each after its length in eight bytes (lowest first). So the file's digest stands for
/// specification and data together.
std::string DatasetFrame(const v1::CreateTrainingJobRequest& message);

struct TrainingInput {
  meta::TrainingSpec spec;
  data::Dataset fleet;
};

/// Reads the file whole. Errors: DataLoss if it was not written by DatasetFrame from checked
/// messages.
absl::StatusOr<TrainingInput> ReadDatasetFile(std::string_view bytes);

}  // namespace metaekf::server
