#pragma once

#include <map>
#include <mutex>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "server/store/store.h"

namespace metaekf::server {

/// Who calls.
struct Caller {
  std::string tenant;    ///< whose things can be named
  std::string identity;  ///< for the audit log: "token t3", "local"
  store::Scope scope = store::Scope::kRead;
};

/// What a call shows of its caller.
struct Credentials {
  std::optional<std::string> authorization;  ///< "Bearer TOKEN"
};

/// Decides who calls, and whether they may. Safe to call concurrently.
class AccessControl {
 public:
  /// @param require_tokens  else every caller may do everything, for the default tenant: one on the
  /// server's own machine.
  AccessControl(store::Store& store, store::Clock clock, bool require_tokens)
      : store_(store), clock_(std::move(clock)), require_tokens_(require_tokens) {}

  /// Takes the tokens from the store: at a start, and after each change, which counts from then on.
  absl::Status Reload();

  /// Quick: what it needs is in memory.
  /// Errors: Unauthenticated without a token that is valid now; PermissionDenied if it does not reach
  /// as far as `needed`.
  absl::StatusOr<Caller> Admit(const Credentials& credentials, store::Scope needed) const;

 private:
  absl::StatusOr<Caller> Identify(const Credentials& credentials) const;

  store::Store& store_;
  const store::Clock clock_;
  const bool require_tokens_;
  std::mutex reload_mutex_;  // so that what is read last is taken last
  mutable std::mutex mutex_;
  std::map<std::string, store::Token> tokens_;  // by digest
};

}  // namespace metaekf::server
