#pragma once

#include <vector>

#include "absl/status/status.h"
#include "metaekf/v1/training.pb.h"
#include "server/convert/samples.h"

namespace metaekf::server {

/// Checks the header of a CreateTrainingJob call by itself.
/// Errors: InvalidArgument with violations below "header".
absl::Status CheckTrainingHeader(const v1::CreateTrainingJobRequest::Header& header);

/// Checks the fleet of a job against its specification, before anyone waits for a training that
/// cannot begin: sizes, lengths, periods, masks.
/// Errors: InvalidArgument with the field or trajectory that is wrong; FailedPrecondition if a
/// trajectory is too short.
absl::Status CheckFleet(const v1::CreateTrainingJobRequest::Header& header,
                        const std::vector<SampleChecker::Recording>& recordings);

}  // namespace metaekf::server
