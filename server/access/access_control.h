#pragma once

#include <map>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "server/options.h"
#include "server/store/store.h"

namespace metaekf::server {

/// Who calls.
struct Caller {
  std::string tenant;    ///< whose things can be named
  std::string identity;  ///< for the audit log: "token t3", "certificate press-7", "local"
  store::Scope scope = store::Scope::kRead;
};

/// What a call shows of its caller.
struct Credentials {
  std::optional<std::string> authorization;     ///< "Bearer TOKEN"
  std::vector<std::string> certificate_names{};  ///< of the certificate that the connection showed
  std::string peer_host{};                       ///< its address, see PeerHost
};

/// Decides who calls, and whether they may. Safe to call concurrently.
class AccessControl {
 public:
  /// @param security  as CheckExposure wants it. Where it asks for neither certificates nor tokens, every
  /// caller may do everything, for the default tenant: one on the server's own machine.
  AccessControl(store::Store& store, store::Clock clock, const ServerOptions::Security& security);

  /// Takes the tokens from the store: at a start, and after each change, which counts from then on.
  absl::Status Reload();

  /// Quick: what it needs is in memory.
  /// Errors: Unauthenticated without a token that is valid now or a certificate that is listed;
  /// PermissionDenied if it does not reach as far as `needed`, or the call did not come through a proxy that is named.
  absl::StatusOr<Caller> Admit(const Credentials& credentials, store::Scope needed) const;

 private:
  absl::StatusOr<Caller> Identify(const Credentials& credentials) const;
  absl::StatusOr<Caller> FromToken(const std::string& authorization) const;
  absl::StatusOr<Caller> FromCertificate(const std::vector<std::string>& names) const;

  store::Store& store_;
  const store::Clock clock_;
  const bool require_tokens_;
  const bool require_certificates_;
  std::map<std::string, Caller> by_certificate_;
  std::set<std::string> proxies_;  // empty: any
  std::mutex reload_mutex_;  // so that what is read last is taken last
  mutable std::mutex mutex_;
  std::map<std::string, store::Token> tokens_;  // by digest
};

}  // namespace metaekf::server
