#pragma once

#include <cstdint>
#include <limits>
#include <map>
#include <string>

#include "absl/status/status.h"

namespace metaekf::store {

struct Context;
class Connection;

/// How much a tenant may have at a time; nothing is refused that it has already.
struct Quota {
  static constexpr int64_t kNoLimit = std::numeric_limits<int64_t>::max();
  int64_t sessions = kNoLimit;
  int64_t adaptations = kNoLimit;
  int64_t stored_bytes = kNoLimit;  ///< model files, adaptations, and data of jobs that have not ended
  int64_t queued_jobs = kNoLimit;
  int64_t running_jobs = kNoLimit;  ///< the others wait
  double samples_per_s = std::numeric_limits<double>::infinity();  ///< of its streams, which are slowed down to it
};

/// The quotas of all tenants.
struct Quotas {
  Quota others;  ///< of each tenant that is not named
  std::map<std::string, Quota> by_tenant;

  const Quota& Of(const std::string& tenant) const {
    const auto found = by_tenant.find(tenant);
    return found == by_tenant.end() ? others : found->second;
  }
};

/// Whether the context's tenant may have one more, in the write transaction that makes it.
/// Errors: ResourceExhausted with what it has.
absl::Status CheckMaySession(const Context& context, Connection& connection);
absl::Status CheckMayAdaptation(const Context& context, Connection& connection);
absl::Status CheckMayQueueJob(const Context& context, Connection& connection);
/// @param added  bytes that would be stored besides.
absl::Status CheckMayStore(const Context& context, Connection& connection, int64_t added);

}  // namespace metaekf::store
