#include "client/src/status.h"

#include "google/rpc/error_details.pb.h"
#include "google/rpc/status.pb.h"

namespace metaekf::client {
namespace {

void AddDetail(const google::protobuf::Any& any, Status& status) {
  if (google::rpc::BadRequest bad; any.Is<google::rpc::BadRequest>() && any.UnpackTo(&bad)) {
    for (const auto& violation : bad.field_violations()) {
      status.violations.push_back({violation.field(), violation.description()});
    }
  }
  if (google::rpc::ErrorInfo info; any.Is<google::rpc::ErrorInfo>() && any.UnpackTo(&info)) {
    status.reason = info.reason();
    status.metadata.insert(info.metadata().begin(), info.metadata().end());
  }
  if (google::rpc::RetryInfo retry; any.Is<google::rpc::RetryInfo>() && any.UnpackTo(&retry)) {
    status.retry_delay_s = static_cast<double>(retry.retry_delay().seconds()) +
                           1e-9 * static_cast<double>(retry.retry_delay().nanos());
  }
}

}  // namespace

Status FromGrpc(const grpc::Status& status) {
  Status result = Error(static_cast<Code>(status.error_code()), status.error_message());
  google::rpc::Status rich;
  if (!status.error_details().empty() && rich.ParseFromString(status.error_details())) {
    for (const auto& detail : rich.details()) AddDetail(detail, result);
  }
  return result;
}

}  // namespace metaekf::client
