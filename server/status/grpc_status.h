#pragma once

#include <grpcpp/support/status.h>

#include "absl/status/status.h"

namespace metaekf::server {

/// The one place where a status becomes what a client receives: same code, same message, and the
/// payloads of details.h in the trailer grpc-status-details-bin (a google.rpc.Status).
///
/// Nothing internal leaves: Internal and Unknown are logged and sent with a general message instead
/// of their own, absolute paths are hidden (text.h). DataLoss is logged, too. Message and details
/// stay below 8 KiB, what a client accepts as trailers; details that do not fit are left out.
grpc::Status ToGrpcStatus(const absl::Status& status);

}  // namespace metaekf::server
