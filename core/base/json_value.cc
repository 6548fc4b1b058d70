#include "core/base/json_value.h"

#include <nlohmann/json.hpp>
#include <utility>

namespace metaekf::base {

JsonValue::JsonValue() : JsonValue(nlohmann::json::object()) {}

JsonValue::JsonValue(nlohmann::json value) : value_(std::make_shared<const nlohmann::json>(std::move(value))) {}

}  // namespace metaekf::base
