#include "server/convert/time.h"

#include <google/protobuf/util/time_util.h>

namespace metaekf::server {

google::protobuf::Timestamp ToTimestamp(absl::Time time) {
  return google::protobuf::util::TimeUtil::MicrosecondsToTimestamp(absl::ToUnixMicros(time));
}

}  // namespace metaekf::server
