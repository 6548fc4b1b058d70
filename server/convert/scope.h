#pragma once

#include "absl/status/statusor.h"
#include "metaekf/v1/admin.pb.h"
#include "server/store/scope.h"

namespace metaekf::server {

/// Errors: InvalidArgument naming the four scopes.
absl::StatusOr<store::Scope> ToScope(v1::Scope scope);
v1::Scope ToMessage(store::Scope scope);

}  // namespace metaekf::server
