#pragma once

#include <string>
#include <vector>

#include "server/store/context.h"
#include "server/store/scope.h"

namespace metaekf::store {

/// A bearer token, without its secret.
struct Token {
  std::string id;      ///< "t1", "t2", …
  std::string digest;  ///< SHA-256 of its secret, 64 hexadecimal digits
  std::string tenant;
  Scope scope = Scope::kRead;
  std::string note;  ///< for whom, as its maker said
  absl::Time create_time;
  absl::Time expire_time = absl::InfiniteFuture();
  absl::Time revoke_time = absl::InfiniteFuture();
};

struct NewToken {
  Token token;
  std::string secret;  ///< what a client shows; the store keeps its digest only
};

/// Bearer tokens of all tenants. A secret has 256 random bits: its digest needs no salt, and how
/// long it takes to look it up tells nothing. Safe to call concurrently.
class TokenStore {
 public:
  /// @param context  of whoever acts.
  explicit TokenStore(Context context) : context_(std::move(context)) {}

  /// @param lifetime  infinite: it does not expire.
  /// Errors: InvalidArgument for a bad tenant name, or a lifetime that is not positive.
  absl::StatusOr<NewToken> Create(const std::string& tenant, Scope scope, absl::Duration lifetime,
                                  const std::string& note);
  /// All, expired and revoked ones too, the oldest first.
  absl::StatusOr<std::vector<Token>> List();
  /// From now on; no change if it was revoked before. Errors: NotFound.
  absl::StatusOr<Token> Revoke(const std::string& id);

 private:
  Context context_;
};

}  // namespace metaekf::store
