#include "core/base/json_fields.h"

#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/numbers.h"

namespace metaekf::base {
namespace {

const nlohmann::json& EmptyObject() {
  static const nlohmann::json empty = nlohmann::json::object();
  return empty;
}

std::string Shown(const nlohmann::json& value) {
  std::string text = value.dump(-1, ' ', false, nlohmann::json::error_handler_t::replace);
  return text.size() > 60 ? text.substr(0, 60) + "…" : text;
}

}  // namespace

JsonFields::JsonFields(const nlohmann::json& object, std::string path) : object_(&object), path_(std::move(path)) {
  if (!object.is_object()) {
    status_ = absl::InvalidArgumentError(absl::StrCat(path_, ": expected an object, got ", Shown(object)));
    object_ = &EmptyObject();
  }
}

bool JsonFields::Has(const std::string& name) const { return object_->contains(name); }

const nlohmann::json* JsonFields::Find(const std::string& name) {
  read_.insert(name);
  const auto it = object_->find(name);
  return it == object_->end() ? nullptr : &*it;
}

void JsonFields::Fail(const std::string& name, const std::string& what) {
  Include(absl::InvalidArgumentError(absl::StrCat(path_.empty() ? "" : path_ + ".", name, ": ", what)));
}

void JsonFields::Include(const absl::Status& status) { status_.Update(status); }

double JsonFields::ReadNumber(const nlohmann::json& value, const std::string& name, double low, double high,
                              bool whole) {
  double number = std::nan("");
  if (value.is_number()) {
    number = value.get<double>();
  } else if (value.is_string()) {
    number = ParseDouble(value.get<std::string>()).value_or(std::nan(""));
  }
  if (!(number >= low && number <= high) || (whole && number != std::floor(number))) {
    Fail(name, absl::StrCat("expected ", whole ? "a whole number" : "a number", " from ", FormatShort(low, 17), " to ",
                            FormatShort(high, 17), ", got ", Shown(value)));
    return low;
  }
  return number;
}

double JsonFields::Number(const std::string& name, double default_value, double low, double high) {
  const nlohmann::json* value = Find(name);
  return value == nullptr ? default_value : ReadNumber(*value, name, low, high, false);
}

int64_t JsonFields::Integer(const std::string& name, int64_t default_value, int64_t low, int64_t high) {
  const nlohmann::json* value = Find(name);
  if (value == nullptr) return default_value;
  // Beyond 2⁵³ a double would lose digits, and seeds are 64 bits wide.
  if (value->is_number_integer()) {
    const int64_t number = value->get<int64_t>();
    if (number >= low && number <= high) return number;
  }
  if (value->is_string()) {
    const std::string text = value->get<std::string>();
    if (!text.empty() && text.size() <= 18 && text.find_first_not_of("0123456789") == std::string::npos) {
      const int64_t number = std::stoll(text);
      if (number >= low && number <= high) return number;
    }
  }
  return static_cast<int64_t>(
      ReadNumber(*value, name, static_cast<double>(low), static_cast<double>(high), true));
}

bool JsonFields::Bool(const std::string& name, bool default_value) {
  const nlohmann::json* value = Find(name);
  if (value == nullptr) return default_value;
  if (!value->is_boolean()) {
    Fail(name, absl::StrCat("expected true or false, got ", Shown(*value)));
    return default_value;
  }
  return value->get<bool>();
}

std::string JsonFields::String(const std::string& name, const std::string& default_value) {
  const nlohmann::json* value = Find(name);
  if (value == nullptr) return default_value;
  if (!value->is_string()) {
    Fail(name, absl::StrCat("expected text, got ", Shown(*value)));
    return default_value;
  }
  return value->get<std::string>();
}

std::vector<int32_t> JsonFields::Integers(const std::string& name, int32_t low, int32_t high) {
  std::vector<int32_t> result;
  const nlohmann::json* value = Find(name);
  if (value == nullptr) return result;
  if (!value->is_array()) Fail(name, absl::StrCat("expected a list, got ", Shown(*value)));
  for (size_t i = 0; value->is_array() && i < value->size(); ++i) {
    result.push_back(static_cast<int32_t>(ReadNumber((*value)[i], absl::StrCat(name, "[", i, "]"), low, high, true)));
  }
  return result;
}

std::vector<double> JsonFields::Numbers(const std::string& name) {
  std::vector<double> result;
  const nlohmann::json* value = Find(name);
  if (value == nullptr) return result;
  if (!value->is_array()) Fail(name, absl::StrCat("expected a list, got ", Shown(*value)));
  constexpr double kLargest = std::numeric_limits<double>::max();
  for (size_t i = 0; value->is_array() && i < value->size(); ++i) {
    result.push_back(ReadNumber((*value)[i], absl::StrCat(name, "[", i, "]"), -kLargest, kLargest, false));
  }
  return result;
}

std::map<std::string, double> JsonFields::NumbersByName(const std::string& name, double low, double high) {
  std::map<std::string, double> result;
  const nlohmann::json* value = Find(name);
  if (value == nullptr) return result;
  if (!value->is_object()) {
    Fail(name, absl::StrCat("expected an object, got ", Shown(*value)));
    return result;
  }
  for (const auto& item : value->items()) {
    result[item.key()] = ReadNumber(item.value(), absl::StrCat(name, ".", item.key()), low, high, false);
  }
  return result;
}

int64_t JsonFields::ChoiceIndex(const std::string& name, const std::vector<std::string>& names) {
  const nlohmann::json* value = Find(name);
  if (value == nullptr) return -1;
  if (value->is_string()) {
    for (size_t i = 0; i < names.size(); ++i) {
      if (names[i] == value->get<std::string>()) return static_cast<int64_t>(i);
    }
  }
  Fail(name, absl::StrCat("expected one of ", absl::StrJoin(names, ", "), ", got ", Shown(*value)));
  return -1;
}

JsonFields JsonFields::Object(const std::string& name) {
  const nlohmann::json* value = Find(name);
  return JsonFields(value == nullptr ? EmptyObject() : *value, path_.empty() ? name : path_ + "." + name);
}

absl::Status JsonFields::Finish() {
  for (const auto& item : object_->items()) {
    if (read_.count(item.key()) == 0) Fail(item.key(), "no field of this name");
  }
  return status_;
}

absl::Status ParseJson(const std::string& text, nlohmann::json* result) {
  *result = nlohmann::json::parse(text, nullptr, /*allow_exceptions=*/false);
  if (result->is_discarded()) return absl::InvalidArgumentError("not valid JSON");
  return absl::OkStatus();
}

}  // namespace metaekf::base
