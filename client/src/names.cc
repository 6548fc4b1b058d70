#include "client/src/names.h"

#include <charconv>

#include "client/src/status.h"

namespace metaekf::client {
namespace {

bool IsLower(char c) { return c >= 'a' && c <= 'z'; }
bool IsDigit(char c) { return c >= '0' && c <= '9'; }

/// [a-z0-9][a-z0-9_-]{0,62}
bool IsId(const std::string& text) {
  if (text.empty() || text.size() > 63 || text[0] == '_' || text[0] == '-') return false;
  for (const char c : text) {
    if (!IsLower(c) && !IsDigit(c) && c != '_' && c != '-') return false;
  }
  return true;
}

bool IsNumber(const std::string& text) {
  return text.find_first_not_of("0123456789") == std::string::npos && text.size() <= 9 &&
         text.find_first_not_of('0') == 0;
}

constexpr char kIdRule[] =
    "lower-case letters, digits, - and _, at most 63, the first a letter or digit";

Status BadModel(const std::string& model) {
  return Error(Code::kInvalidArgument, "\"" + model +
                                           "\" is no model's name: write NAME, NAME@VERSION or "
                                           "NAME@ALIAS, with " +
                                           kIdRule);
}

}  // namespace

Result<std::string> ModelResource(const std::string& model) {
  if (model.starts_with("models/")) return model;
  const size_t at = model.find('@');
  const std::string name = model.substr(0, at);
  if (!IsId(name)) return BadModel(model);
  if (at == std::string::npos) return "models/" + name;
  const std::string which = model.substr(at + 1);
  if (IsNumber(which)) return "models/" + name + "/versions/" + which;
  if (IsId(which) && IsLower(which[0])) return "models/" + name + "/aliases/" + which;
  return BadModel(model);
}

Result<std::string> BareModelResource(const std::string& model) {
  Result<std::string> resource = ModelResource(model);
  if (!resource.ok() || Segment(*resource, 2).empty()) return resource;
  return Error(Code::kInvalidArgument,
               "\"" + model + "\" names a version; the model's name alone is needed here");
}

Result<std::string> Resource(const std::string& collection, const std::string& id) {
  if (id.starts_with(collection + "/")) return id;
  if (IsId(id)) return collection + "/" + id;
  return Error(Code::kInvalidArgument, "\"" + id + "\" is no id in " + collection + ": " + kIdRule);
}

Result<std::string> TargetResource(const Target& target) {
  if (target.model.empty() == target.adaptation.empty()) {
    return Error(Code::kInvalidArgument, "give a model or an adaptation, one of the two");
  }
  return target.model.empty() ? Resource("adaptations", target.adaptation)
                              : ModelResource(target.model);
}

std::string Segment(const std::string& resource, int index) {
  size_t start = 0;
  for (; index > 0; --index) {
    start = resource.find('/', start);
    if (start == std::string::npos) return "";
    ++start;
  }
  return resource.substr(start, resource.find('/', start) - start);
}

uint32_t VersionOf(const std::string& resource) {
  uint32_t version = 0;
  if (Segment(resource, 2) != "versions") return 0;
  const std::string text = Segment(resource, 3);
  std::from_chars(text.data(), text.data() + text.size(), version);
  return version;
}

}  // namespace metaekf::client
