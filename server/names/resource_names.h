#pragma once

#include <cstdint>
#include <string>

#include "absl/status/statusor.h"

/// Resource names: the one place where they are put together and taken apart. All Parse functions
/// return InvalidArgument with a violation of `field` for a name of another form.
namespace metaekf::server {

/// What a name that stands for model parameters means.
struct Target {
  enum class Kind { kLatest, kVersion, kAlias, kAdaptation };
  Kind kind = Kind::kLatest;
  std::string model;
  int64_t version = 0;
  std::string alias;
  std::string adaptation;
};

/// models/{model}, models/{model}/versions/{version}, models/{model}/aliases/{alias} or
/// adaptations/{adaptation}.
absl::StatusOr<Target> ParseTarget(const std::string& field, const std::string& name);

/// The same without adaptations.
absl::StatusOr<Target> ParseModelTarget(const std::string& field, const std::string& name);

/// The {model} of models/{model}.
absl::StatusOr<std::string> ParseModelName(const std::string& field, const std::string& name);
/// Kind kVersion only.
absl::StatusOr<Target> ParseVersionName(const std::string& field, const std::string& name);
/// Kind kAlias only.
absl::StatusOr<Target> ParseAliasName(const std::string& field, const std::string& name);
absl::StatusOr<std::string> ParseAdaptationName(const std::string& field, const std::string& name);
absl::StatusOr<int64_t> ParseJobName(const std::string& field, const std::string& name);
absl::StatusOr<int64_t> ParseSessionName(const std::string& field, const std::string& name);

/// OK if `id` may be the last part of a resource name that a client chooses.
absl::Status CheckId(const std::string& field, const std::string& id);

std::string ModelName(const std::string& model);
std::string VersionName(const std::string& model, int64_t version);
std::string AliasName(const std::string& model, const std::string& alias);
std::string AdaptationName(const std::string& adaptation);
std::string JobName(int64_t number);
std::string SessionName(int64_t number);

}  // namespace metaekf::server
