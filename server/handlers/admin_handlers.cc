#include "server/handlers/admin_handlers.h"

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "absl/strings/strip.h"
#include "core/base/status.h"
#include "server/convert/scope.h"
#include "server/convert/time.h"
#include "server/handlers/page.h"
#include "server/status/details.h"
#include "server/store/names.h"

namespace metaekf::server {
namespace {

constexpr size_t kMaxNoteBytes = 256;
constexpr absl::string_view kPrefix = "tokens/";

v1::Token ToMessage(const store::Token& token) {
  v1::Token message;
  message.set_name(absl::StrCat(kPrefix, token.id));
  message.set_tenant(token.tenant);
  message.set_scope(server::ToMessage(token.scope));
  message.set_note(token.note);
  *message.mutable_create_time() = ToTimestamp(token.create_time);
  if (token.expire_time != absl::InfiniteFuture()) {
    *message.mutable_expire_time() = ToTimestamp(token.expire_time);
  }
  if (token.revoke_time != absl::InfiniteFuture()) {
    *message.mutable_revoke_time() = ToTimestamp(token.revoke_time);
  }
  return message;
}

}  // namespace

absl::Status CreateToken(CallContext& context, const v1::CreateTokenRequest& request,
                         v1::CreateTokenResponse* response) {
  const std::string tenant = request.tenant().empty() ? store::kDefaultTenant : request.tenant();
  if (const absl::Status named = store::CheckName("tenant", tenant); !named.ok()) {
    return FieldViolation("tenant", std::string(named.message()));
  }
  const absl::StatusOr<store::Scope> scope = ToScope(request.scope());
  if (!scope.ok()) return FieldViolation("scope", std::string(scope.status().message()));
  absl::Duration lifetime = absl::InfiniteDuration();
  if (request.has_lifetime()) {
    lifetime = absl::Seconds(request.lifetime().seconds()) +
               absl::Nanoseconds(request.lifetime().nanos());
    if (lifetime <= absl::ZeroDuration()) return FieldViolation("lifetime", "must be positive");
  }
  if (request.note().size() > kMaxNoteBytes) {
    return FieldViolation("note", absl::StrCat("has ", request.note().size(), " bytes, at most ",
                                               kMaxNoteBytes, " are taken"));
  }
  METAEKF_ASSIGN_OR_RETURN(const store::NewToken made,
                           context.server.store.Tokens(context.caller.identity)
                               .Create(tenant, *scope, lifetime, request.note()));
  METAEKF_RETURN_IF_ERROR(context.server.access.Reload());
  *response->mutable_token() = ToMessage(made.token);
  response->set_secret(made.secret);
  return absl::OkStatus();
}

absl::Status ListTokens(CallContext& context, const v1::ListTokensRequest&,
                        v1::ListTokensResponse* response) {
  METAEKF_ASSIGN_OR_RETURN(const auto tokens, context.server.store.Tokens().List());
  for (const store::Token& token : tokens) *response->add_tokens() = ToMessage(token);
  return absl::OkStatus();
}

absl::Status RevokeToken(CallContext& context, const v1::RevokeTokenRequest& request,
                         v1::Token* response) {
  absl::string_view id = request.name();
  if (!absl::ConsumePrefix(&id, kPrefix)) {
    return FieldViolation("name", absl::StrCat("'", request.name(), "' is not tokens/{token}"));
  }
  METAEKF_ASSIGN_OR_RETURN(
      const store::Token token,
      context.server.store.Tokens(context.caller.identity).Revoke(std::string(id)));
  METAEKF_RETURN_IF_ERROR(context.server.access.Reload());
  *response = ToMessage(token);
  return absl::OkStatus();
}

absl::Status ListAuditEntries(CallContext& context, const v1::ListAuditEntriesRequest& request,
                              v1::ListAuditEntriesResponse* response) {
  METAEKF_ASSIGN_OR_RETURN(const auto page,
                           ListPage(request, [&](const store::PageRequest& wanted) {
                             return context.server.store.audit().List(wanted, request.tenant());
                           }));
  for (const store::AuditEntry& entry : page.items) {
    v1::AuditEntry& message = *response->add_entries();
    message.set_number(static_cast<uint64_t>(entry.number));
    *message.mutable_time() = ToTimestamp(entry.time);
    message.set_tenant(entry.tenant);
    message.set_identity(entry.identity);
    message.set_action(entry.action);
    message.set_resource(entry.resource);
    message.set_detail(entry.detail);
  }
  response->set_next_page_token(page.next_page_token);
  return absl::OkStatus();
}

}  // namespace metaekf::server
