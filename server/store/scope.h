#pragma once

#include <string>

#include "absl/status/statusor.h"

namespace metaekf::store {

/// What a client may do; each may do what those before it may.
enum class Scope {
  kRead,    ///< look, predict
  kStream,  ///< have sessions of estimates, as a machine with sensors does
  kWrite,   ///< make, change and delete everything that its tenant has
  kAdmin,   ///< look after the server: tokens, audit, backups
};

/// "read", "stream", "write" or "admin".
const char* ScopeName(Scope scope);
/// Errors: InvalidArgument naming the four.
absl::StatusOr<Scope> ScopeNamed(const std::string& name);

}  // namespace metaekf::store
