#pragma once

#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/store/context.h"

namespace metaekf::store {

/// Makes a creation idempotent: the same id again, within a week, gives what the first made.
struct RequestId {
  std::string id;           ///< the client's, at most 128 bytes; empty: not idempotent
  std::string fingerprint;  ///< of what was asked for: the same id with another is an error
};

/// What a request made: its name, its number, or both, as its kind has them.
struct RequestResult {
  std::string name;
  int64_t number = 0;
};

/// What `request` made before, if it did.
/// Errors: InvalidArgument for too long an id; AlreadyExists if the id was used with another
/// fingerprint.
absl::StatusOr<std::optional<RequestResult>> FindRequest(const Context& context,
                                                         Connection& connection,
                                                         const std::string& kind,
                                                         const RequestId& request);

/// Remembers what `request` has made, in the transaction that made it.
absl::Status RecordRequest(const Context& context, Connection& connection, const std::string& kind,
                           const RequestId& request, const RequestResult& result);

}  // namespace metaekf::store
