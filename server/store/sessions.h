#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "server/store/context.h"
#include "server/store/page.h"

namespace metaekf::store {

/// One client's filter, as far as it survives the server.
struct Session {
  int64_t number = 0;
  std::string target;    ///< the version or adaptation that it runs on
  std::string settings;  ///< what it was opened with; opaque
  int64_t epoch = 0;     ///< one more each time that it is claimed
  int64_t durable_seq = 0;
  std::string checkpoint;  ///< the filter after sample durable_seq; opaque; empty before the first
  absl::Time create_time;
};

struct NewSession {
  Session session;
  std::string token;  ///< needed to claim it; the store keeps its digest only
};

struct SessionCheckpoint {
  std::string tenant;
  int64_t number = 0;
  int64_t epoch = 0;
  int64_t durable_seq = 0;
  std::string checkpoint;
};

/// Estimation sessions of a tenant. The epoch is a fencing token: who claims a session takes it from whoever
/// had it before. Safe to call concurrently.
class SessionStore {
 public:
  explicit SessionStore(Context context) : context_(std::move(context)) {}

  /// Makes a session and claims it: epoch 1. Errors: those of quota.h.
  absl::StatusOr<NewSession> Create(const std::string& target, const std::string& settings);

  /// Takes the session: its next epoch.
  /// Errors: NotFound if there is none or the token is wrong; which of them is not told.
  absl::StatusOr<Session> Claim(int64_t number, const std::string& token);

  /// Errors: NotFound.
  absl::StatusOr<Session> Get(int64_t number);
  /// Newest first.
  absl::StatusOr<Page<Session>> List(const PageRequest& request);
  /// Errors: NotFound.
  absl::Status Delete(int64_t number);

 private:
  Context context_;
};

/// Writes checkpoints of any tenants in one commit.
/// @return for each, whether it was written; false: the session is no longer of that epoch.
absl::StatusOr<std::vector<bool>> SaveCheckpoints(Database& database,
                                                  const std::vector<SessionCheckpoint>& checkpoints);

}  // namespace metaekf::store
