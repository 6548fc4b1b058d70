#pragma once

#include <string>

#include "absl/status/statusor.h"

namespace metaekf::store {

/// 256 random bits, as 64 hexadecimal digits.
absl::StatusOr<std::string> NewSecret();

}  // namespace metaekf::store
