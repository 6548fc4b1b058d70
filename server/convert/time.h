#pragma once

#include <google/protobuf/timestamp.pb.h>

#include "absl/time/time.h"

namespace metaekf::server {

/// To microseconds, as the store keeps times.
google::protobuf::Timestamp ToTimestamp(absl::Time time);

}  // namespace metaekf::server
