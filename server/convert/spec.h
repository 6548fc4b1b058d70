#pragma once

#include <nlohmann/json_fwd.hpp>
#include <string>

#include "absl/status/statusor.h"
#include "core/meta/training_spec.h"
#include "metaekf/v1/spec.pb.h"

namespace metaekf::server {

/// Reads a specification from a request.
/// @param field  of the request that holds it, e.g. "header.spec".
/// Errors: InvalidArgument with a violation of the field below it that is wrong.
absl::StatusOr<meta::TrainingSpec> ToCore(const std::string& field,
                                          const v1::TrainingSpec& message);

/// The message for what core keeps as JSON. Errors: InvalidArgument if it is not of that form.
absl::StatusOr<v1::TrainingSpec> ToTrainingSpecMessage(const nlohmann::json& training);

/// An error of core that starts with the path of a field ("model.window: …") as a violation of that
/// field below `field`; one that does not, as a violation of `field`. Other codes pass unchanged.
absl::Status InField(const std::string& field, const absl::Status& status);

}  // namespace metaekf::server
