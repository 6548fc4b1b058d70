#include "server/names/resource_names.h"

#include <vector>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/base/status.h"
#include "server/status/details.h"
#include "server/store/names.h"

namespace metaekf::server {
namespace {

constexpr size_t kMaxShown = 80;

absl::Status WrongForm(const std::string& field, const std::string& name,
                       const std::string& expected) {
  return FieldViolation(
      field, absl::StrCat("'", name.substr(0, kMaxShown), "' is not of the form ", expected));
}

/// A positive number written the one way that we write it.
bool ParseNumber(const std::string& text, int64_t* number) {
  return absl::SimpleAtoi(text, number) && *number > 0 && absl::StrCat(*number) == text;
}

absl::StatusOr<int64_t> ParseNumbered(const std::string& collection, const std::string& field,
                                      const std::string& name) {
  const std::vector<std::string> parts = absl::StrSplit(name, '/');
  int64_t number = 0;
  if (parts.size() == 2 && parts[0] == collection && ParseNumber(parts[1], &number)) return number;
  return WrongForm(field, name, absl::StrCat(collection, "/{number}"));
}

/// OK, or the violation of `field` that `status` describes.
absl::Status InField(const std::string& field, const absl::Status& status) {
  return status.ok() ? status : FieldViolation(field, std::string(status.message()));
}

/// A name of one of the three forms under models/, or nothing.
bool SplitModelTarget(const std::string& name, Target* target) {
  const std::vector<std::string> parts = absl::StrSplit(name, '/');
  if (parts.size() < 2 || parts[0] != "models") return false;
  target->model = parts[1];
  if (parts.size() == 2) return true;
  if (parts.size() != 4) return false;
  if (parts[2] == "versions" && ParseNumber(parts[3], &target->version)) {
    target->kind = Target::Kind::kVersion;
    return true;
  }
  target->kind = Target::Kind::kAlias;
  target->alias = parts[3];
  return parts[2] == "aliases";
}

absl::Status CheckIds(const std::string& field, const Target& target) {
  METAEKF_RETURN_IF_ERROR(InField(field, store::CheckName("model name", target.model)));
  if (target.kind != Target::Kind::kAlias) return absl::OkStatus();
  return InField(field, store::CheckAlias(target.alias));
}

/// A target under models/ of the one kind that `expected` shows.
absl::StatusOr<Target> ParseKind(Target::Kind kind, const std::string& field,
                                 const std::string& name, const std::string& expected) {
  Target target;
  if (!SplitModelTarget(name, &target) || target.kind != kind) {
    return WrongForm(field, name, expected);
  }
  METAEKF_RETURN_IF_ERROR(CheckIds(field, target));
  return target;
}

}  // namespace

absl::StatusOr<Target> ParseTarget(const std::string& field, const std::string& name) {
  if (!absl::StartsWith(name, "adaptations/")) return ParseModelTarget(field, name);
  METAEKF_ASSIGN_OR_RETURN(std::string adaptation, ParseAdaptationName(field, name));
  return Target{.kind = Target::Kind::kAdaptation, .adaptation = std::move(adaptation)};
}

absl::StatusOr<Target> ParseModelTarget(const std::string& field, const std::string& name) {
  Target target;
  if (!SplitModelTarget(name, &target)) {
    return WrongForm(field, name,
                     "models/{model}, models/{model}/versions/{version} or "
                     "models/{model}/aliases/{alias}");
  }
  METAEKF_RETURN_IF_ERROR(CheckIds(field, target));
  return target;
}

absl::StatusOr<std::string> ParseModelName(const std::string& field, const std::string& name) {
  METAEKF_ASSIGN_OR_RETURN(Target target,
                           ParseKind(Target::Kind::kLatest, field, name, "models/{model}"));
  return std::move(target.model);
}

absl::StatusOr<Target> ParseVersionName(const std::string& field, const std::string& name) {
  return ParseKind(Target::Kind::kVersion, field, name, "models/{model}/versions/{version}");
}

absl::StatusOr<Target> ParseAliasName(const std::string& field, const std::string& name) {
  return ParseKind(Target::Kind::kAlias, field, name, "models/{model}/aliases/{alias}");
}

absl::StatusOr<std::string> ParseAdaptationName(const std::string& field, const std::string& name) {
  const std::vector<std::string> parts = absl::StrSplit(name, '/');
  if (parts.size() != 2 || parts[0] != "adaptations") {
    return WrongForm(field, name, "adaptations/{adaptation}");
  }
  METAEKF_RETURN_IF_ERROR(CheckId(field, parts[1]));
  return parts[1];
}

absl::StatusOr<int64_t> ParseJobName(const std::string& field, const std::string& name) {
  return ParseNumbered("jobs", field, name);
}

absl::StatusOr<int64_t> ParseSessionName(const std::string& field, const std::string& name) {
  return ParseNumbered("sessions", field, name);
}

absl::Status CheckId(const std::string& field, const std::string& id) {
  return InField(field, store::CheckName("name", id));
}

std::string ModelName(const std::string& model) { return absl::StrCat("models/", model); }
std::string VersionName(const std::string& model, int64_t version) {
  return absl::StrCat("models/", model, "/versions/", version);
}
std::string AliasName(const std::string& model, const std::string& alias) {
  return absl::StrCat("models/", model, "/aliases/", alias);
}
std::string AdaptationName(const std::string& adaptation) {
  return absl::StrCat("adaptations/", adaptation);
}
std::string JobName(int64_t number) { return absl::StrCat("jobs/", number); }
std::string SessionName(int64_t number) { return absl::StrCat("sessions/", number); }

}  // namespace metaekf::server
