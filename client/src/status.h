#pragma once

#include <grpcpp/support/status.h>

#include <string>
#include <utility>

#include "metaekf/client.h"

/// Returns from the enclosing function if `expression` (a client::Status) is an error.
#define METAEKF_CLIENT_RETURN_IF_ERROR(expression)                                       \
  do {                                                                                   \
    if (::metaekf::client::Status status_ = (expression); !status_.ok()) return status_; \
  } while (false)

namespace metaekf::client {

inline Status Error(Code code, std::string message) {
  return Status{.code = code, .message = std::move(message)};
}

/// What the server sent, with the details (google.rpc) that came along.
Status FromGrpc(const grpc::Status& status);

}  // namespace metaekf::client
