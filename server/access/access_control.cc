#include "server/access/access_control.h"

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/string_view.h"
#include "absl/strings/strip.h"
#include "core/base/status.h"
#include "server/access/exposure.h"
#include "server/store/sha256.h"

namespace metaekf::server {

AccessControl::AccessControl(store::Store& store, store::Clock clock,
                             const ServerOptions::Security& security)
    : store_(store),
      clock_(std::move(clock)),
      require_tokens_(security.require_tokens),
      require_certificates_(!security.client_ca_file.empty()) {
  for (const auto& client : security.clients) {
    by_certificate_[client.certificate_name] = {
        client.tenant, absl::StrCat("certificate ", client.certificate_name), client.scope};
  }
  for (const std::string& proxy : security.proxies) proxies_.insert(CanonicalAddress(proxy));
}

absl::Status AccessControl::Reload() {
  std::lock_guard one_at_a_time(reload_mutex_);
  METAEKF_ASSIGN_OR_RETURN(const std::vector<store::Token> stored, store_.Tokens().List());
  std::map<std::string, store::Token> tokens;
  for (const store::Token& token : stored) tokens[token.digest] = token;
  std::lock_guard lock(mutex_);
  tokens_ = std::move(tokens);
  return absl::OkStatus();
}

absl::StatusOr<Caller> AccessControl::Identify(const Credentials& credentials) const {
  if (!proxies_.empty() && proxies_.count(credentials.peer_host) == 0) {
    return absl::PermissionDeniedError(
        "this server takes calls from its proxies alone (security.proxies in its configuration)");
  }
  if (!require_tokens_ && !require_certificates_) {
    return Caller{store::kDefaultTenant, "local", store::Scope::kAdmin};
  }
  if (credentials.authorization) return FromToken(*credentials.authorization);
  if (!require_tokens_) return FromCertificate(credentials.certificate_names);
  return absl::UnauthenticatedError(
      "this server wants a token: send the metadata 'authorization: Bearer TOKEN' (metaekf: "
      "--token-file FILE, or METAEKF_TOKEN)");
}

absl::StatusOr<Caller> AccessControl::FromCertificate(const std::vector<std::string>& names) const {
  for (const std::string& name : names) {
    const auto found = by_certificate_.find(name);
    if (found != by_certificate_.end()) return found->second;
  }
  return absl::UnauthenticatedError(
      absl::StrCat("the certificate is valid, but its name (", absl::StrJoin(names, ", "),
                   ") is not among those that may call (security.clients in the server's configuration)"));
}

absl::StatusOr<Caller> AccessControl::FromToken(const std::string& authorization) const {
  absl::string_view secret = authorization;
  if (!absl::ConsumePrefix(&secret, "Bearer ")) {
    return absl::UnauthenticatedError("the metadata 'authorization' must be 'Bearer TOKEN'");
  }
  const std::string digest = store::Sha256Hex(std::string(secret));
  std::lock_guard lock(mutex_);
  const auto found = tokens_.find(digest);
  if (found == tokens_.end()) return absl::UnauthenticatedError("the token is not known here");
  const store::Token& token = found->second;
  const absl::Time now = clock_();
  if (token.revoke_time <= now) {
    return absl::UnauthenticatedError(absl::StrCat("token ", token.id, " has been revoked"));
  }
  if (token.expire_time <= now) {
    return absl::UnauthenticatedError(absl::StrCat("token ", token.id, " expired at ",
                                                   absl::FormatTime(token.expire_time)));
  }
  return Caller{token.tenant, absl::StrCat("token ", token.id), token.scope};
}

absl::StatusOr<Caller> AccessControl::Admit(const Credentials& credentials,
                                            store::Scope needed) const {
  METAEKF_ASSIGN_OR_RETURN(Caller caller, Identify(credentials));
  if (caller.scope >= needed) return caller;
  return absl::PermissionDeniedError(absl::StrCat("this needs scope ",
                                                  store::ScopeName(needed), ", ", caller.identity,
                                                  " has scope ", store::ScopeName(caller.scope)));
}

}  // namespace metaekf::server
