#pragma once

#include <cstdint>
#include <functional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "server/store/blob_store.h"
#include "server/store/database.h"
#include "server/store/quota.h"

namespace metaekf::store {

using Clock = std::function<absl::Time()>;

/// What every part of the store works with. The tenant is the first part of every key; who acts for
/// it is written down (audit.h).
struct Context {
  Database& database;
  BlobStore& blobs;
  Clock clock;
  std::string jobs_directory;
  std::string tenant;
  std::string identity;
  Quota quota{};  ///< of the tenant
};

/// The next number of a kind, from 1; never the same twice. In a write transaction.
absl::StatusOr<int64_t> NextNumber(const Context& context, Connection& connection,
                                   const std::string& kind);

/// All blobs that something refers to: model files, adaptations, data of jobs that may still run.
absl::StatusOr<std::vector<std::string>> ReferencedBlobs(Connection& connection);

/// Removes a blob unless something refers to it. After the commit that dropped a reference; what a
/// crash in between leaves behind is removed at the next start.
void RemoveIfUnreferenced(const Context& context, const std::string& digest);

}  // namespace metaekf::store
