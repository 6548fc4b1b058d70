#include "server/convert/scope.h"

namespace metaekf::server {

absl::StatusOr<store::Scope> ToScope(v1::Scope scope) {
  switch (scope) {
    case v1::READ:
      return store::Scope::kRead;
    case v1::STREAM:
      return store::Scope::kStream;
    case v1::WRITE:
      return store::Scope::kWrite;
    case v1::ADMIN:
      return store::Scope::kAdmin;
    default:
      return absl::InvalidArgumentError("must be READ, STREAM, WRITE or ADMIN");
  }
}

v1::Scope ToMessage(store::Scope scope) {
  constexpr v1::Scope kScopes[] = {v1::READ, v1::STREAM, v1::WRITE, v1::ADMIN};
  return kScopes[static_cast<int>(scope)];
}

}  // namespace metaekf::server
