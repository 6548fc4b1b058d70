#include "server/convert/spec.h"

#include <nlohmann/json.hpp>

#include "absl/strings/str_cat.h"
#include "core/base/json_fields.h"
#include "core/base/status.h"
#include "server/convert/json.h"
#include "server/status/details.h"

namespace metaekf::server {

absl::StatusOr<meta::TrainingSpec> ToCore(const std::string& field,
                                          const v1::TrainingSpec& message) {
  nlohmann::json json;
  METAEKF_RETURN_IF_ERROR(base::ParseJson(MessageToJson(message), &json));
  auto spec = meta::ReadTrainingSpec(json);
  if (!spec.ok()) return InField(field, spec.status());
  return spec;
}

absl::StatusOr<v1::TrainingSpec> ToTrainingSpecMessage(const nlohmann::json& training) {
  v1::TrainingSpec message;
  METAEKF_RETURN_IF_ERROR(JsonToMessage(training.dump(), &message));
  return message;
}

absl::Status InField(const std::string& field, const absl::Status& status) {
  if (!absl::IsInvalidArgument(status)) return status;
  const std::string message(status.message());
  const size_t colon = message.find(": ");
  if (colon == std::string::npos || message.find(' ') < colon) {
    return FieldViolation(field, message);
  }
  return FieldViolation(absl::StrCat(field, ".", message.substr(0, colon)),
                        message.substr(colon + 2));
}

}  // namespace metaekf::server
