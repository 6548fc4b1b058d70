#pragma once

#include <cstdint>
#include <map>
#include <nlohmann/json_fwd.hpp>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"

namespace metaekf::base {

/// Reads the fields of a JSON object, each with its default, and keeps the first thing that is wrong with it.
///
/// Accepts the JSON form of protobuf messages: numbers may be strings, enumerators are names. Errors name the
/// field by its path ("model.encoder.hidden_widths[2]"). Call Finish last: it also refuses unknown fields.
class JsonFields {
 public:
  /// `object` must outlive the reader and those made from it.
  JsonFields(const nlohmann::json& object, std::string path);

  bool Has(const std::string& name) const;
  double Number(const std::string& name, double default_value, double low, double high);
  int64_t Integer(const std::string& name, int64_t default_value, int64_t low, int64_t high);
  bool Bool(const std::string& name, bool default_value);
  std::string String(const std::string& name, const std::string& default_value);
  std::vector<int32_t> Integers(const std::string& name, int32_t low, int32_t high);
  std::vector<double> Numbers(const std::string& name);
  /// An object whose names are the user's own.
  std::map<std::string, double> NumbersByName(const std::string& name, double low, double high);
  template <typename Enum>
  Enum Choice(const std::string& name, Enum default_value, const std::vector<std::pair<std::string, Enum>>& choices) {
    std::vector<std::string> names;
    for (const auto& choice : choices) names.push_back(choice.first);
    const int64_t index = ChoiceIndex(name, names);
    return index < 0 ? default_value : choices[static_cast<size_t>(index)].second;
  }
  /// The nested object of that name, empty if it is absent. Its errors must be passed on with Include.
  JsonFields Object(const std::string& name);
  void Include(const absl::Status& status);
  /// Notes that `name` is wrong, for checks that span fields.
  void Fail(const std::string& name, const std::string& what);

  /// The first error so far, and an error if a field was not read.
  absl::Status Finish();
  const absl::Status& status() const { return status_; }

 private:
  int64_t ChoiceIndex(const std::string& name, const std::vector<std::string>& names);
  const nlohmann::json* Find(const std::string& name);
  double ReadNumber(const nlohmann::json& value, const std::string& name, double low, double high, bool whole);

  const nlohmann::json* object_;
  std::string path_;
  std::set<std::string> read_;
  absl::Status status_;
};

/// Parses JSON text. Errors: InvalidArgument with the place.
absl::Status ParseJson(const std::string& text, nlohmann::json* result);

}  // namespace metaekf::base
