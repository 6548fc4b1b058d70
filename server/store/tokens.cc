#include "server/store/tokens.h"

#include <optional>

#include "core/base/status.h"
#include "server/store/audit.h"
#include "server/store/names.h"
#include "server/store/secret.h"

namespace metaekf::store {
namespace {

// Of all secrets, so that one found where it should not be is known for what it is.
constexpr const char* kPrefix = "metaekf_";
constexpr const char* kSelect =
    "SELECT id, digest, tenant, scope, note, create_time, expire_time, revoke_time FROM tokens ";

/// 0 is never.
absl::Time LimitOf(int64_t micros) {
  return micros == 0 ? absl::InfiniteFuture() : absl::FromUnixMicros(micros);
}

Token ReadToken(const Row& row) {
  Token token;
  token.id = row.Text(0);
  token.digest = row.Text(1);
  token.tenant = row.Text(2);
  token.scope = *ScopeNamed(row.Text(3));
  token.note = row.Text(4);
  token.create_time = absl::FromUnixMicros(row.Int(5));
  token.expire_time = LimitOf(row.Int(6));
  token.revoke_time = LimitOf(row.Int(7));
  return token;
}

absl::StatusOr<Token> FindToken(Connection& connection, const std::string& id) {
  std::optional<Token> found;
  METAEKF_RETURN_IF_ERROR(connection.Execute(absl::StrCat(kSelect, "WHERE id = ?1"), {id},
                                             [&](const Row& row) { found = ReadToken(row); }));
  if (found) return *std::move(found);
  return absl::NotFoundError(absl::StrCat("there is no token '", id, "'"));
}

}  // namespace

absl::StatusOr<NewToken> TokenStore::Create(const std::string& tenant, Scope scope,
                                            absl::Duration lifetime, const std::string& note) {
  METAEKF_RETURN_IF_ERROR(CheckName("tenant", tenant));
  if (lifetime <= absl::ZeroDuration()) {
    return absl::InvalidArgumentError("the lifetime of a token must be positive");
  }
  METAEKF_ASSIGN_OR_RETURN(const std::string random, NewSecret());
  const std::string secret = absl::StrCat(kPrefix, random);
  return context_.database.Write([&](Connection& connection) -> absl::StatusOr<NewToken> {
    METAEKF_ASSIGN_OR_RETURN(const int64_t number, NextNumber(context_, connection, "token"));
    const std::string id = absl::StrCat("t", number);
    const absl::Time now = context_.clock();
    const int64_t expiry =
        lifetime == absl::InfiniteDuration() ? 0 : absl::ToUnixMicros(now + lifetime);
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        "INSERT INTO tokens (id, digest, tenant, scope, note, create_time, expire_time) "
        "VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)",
        {id, Sha256Hex(secret), tenant, ScopeName(scope), note, absl::ToUnixMicros(now), expiry}));
    METAEKF_RETURN_IF_ERROR(Audit(context_, connection, "CreateToken", absl::StrCat("tokens/", id),
                                  absl::StrCat("tenant ", tenant, ", scope ", ScopeName(scope))));
    METAEKF_ASSIGN_OR_RETURN(Token token, FindToken(connection, id));
    return NewToken{std::move(token), secret};
  });
}

absl::StatusOr<std::vector<Token>> TokenStore::List() {
  using Tokens = absl::StatusOr<std::vector<Token>>;
  return context_.database.Read([&](Connection& connection) -> Tokens {
    std::vector<Token> tokens;
    METAEKF_RETURN_IF_ERROR(
        connection.Execute(absl::StrCat(kSelect, "ORDER BY create_time, id"), {},
                           [&](const Row& row) { tokens.push_back(ReadToken(row)); }));
    return tokens;
  });
}

absl::StatusOr<Token> TokenStore::Revoke(const std::string& id) {
  return context_.database.Write([&](Connection& connection) -> absl::StatusOr<Token> {
    METAEKF_RETURN_IF_ERROR(
        connection.Execute("UPDATE tokens SET revoke_time = ?2 WHERE id = ?1 AND revoke_time = 0",
                           {id, absl::ToUnixMicros(context_.clock())}));
    if (connection.changes() > 0) {
      METAEKF_RETURN_IF_ERROR(
          Audit(context_, connection, "RevokeToken", absl::StrCat("tokens/", id)));
    }
    return FindToken(connection, id);
  });
}

}  // namespace metaekf::store
