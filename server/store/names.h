#pragma once

#include <string>

#include "absl/status/status.h"

namespace metaekf::store {

/// OK if `name` matches [a-z0-9][a-z0-9_-]{0,62}, else InvalidArgument; `what` is e.g. "model
/// name".
absl::Status CheckName(const std::string& what, const std::string& name);

/// As CheckName for an alias, which also starts with a letter: digits mean a version.
absl::Status CheckAlias(const std::string& alias);

}  // namespace metaekf::store
