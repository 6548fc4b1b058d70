#pragma once

#include <memory>
#include <nlohmann/json_fwd.hpp>

namespace metaekf::base {

/// A JSON value that is never changed, so that copies share it. For members of structs that most files include without
/// looking into the JSON: nlohmann's own type takes each of them a second or two to compile.
class JsonValue {
 public:
  JsonValue();  ///< {}
  JsonValue(nlohmann::json value);  // NOLINT: implicit, as of a value
  JsonValue(const JsonValue&) = default;  // and no moves: there is always a value
  JsonValue& operator=(const JsonValue&) = default;

  const nlohmann::json& operator*() const { return *value_; }
  const nlohmann::json* operator->() const { return value_.get(); }

 private:
  std::shared_ptr<const nlohmann::json> value_;
};

}  // namespace metaekf::base
