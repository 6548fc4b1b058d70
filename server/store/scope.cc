#include "server/store/scope.h"

#include "absl/strings/str_cat.h"

namespace metaekf::store {

const char* ScopeName(Scope scope) {
  constexpr const char* kNames[] = {"read", "stream", "write", "admin"};
  return kNames[static_cast<int>(scope)];
}

absl::StatusOr<Scope> ScopeNamed(const std::string& name) {
  for (const Scope scope : {Scope::kRead, Scope::kStream, Scope::kWrite, Scope::kAdmin}) {
    if (name == ScopeName(scope)) return scope;
  }
  return absl::InvalidArgumentError(
      absl::StrCat("scope '", name, "' is none of read, stream, write and admin"));
}

}  // namespace metaekf::store
