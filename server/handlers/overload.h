#pragma once

#include "server/status/details.h"

namespace metaekf::server {

/// What a call gets that the background executor does not take.
inline absl::Status Overloaded() {
  return WithRetryDelay(
      absl::ResourceExhaustedError("the server has too much to do; try again in a second"),
      absl::Seconds(1));
}

}  // namespace metaekf::server
