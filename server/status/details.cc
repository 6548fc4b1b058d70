#include "server/status/details.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "google/rpc/error_details.pb.h"
#include "server/status/text.h"

namespace metaekf::server {
namespace {

// Together below what ToGrpcStatus lets through.
constexpr size_t kMaxViolations = 8;
constexpr size_t kMaxFieldBytes = 80;
constexpr size_t kMaxDescriptionBytes = 200;

absl::Status WithDetail(absl::Status status, const google::protobuf::Message& detail) {
  status.SetPayload(absl::StrCat("type.googleapis.com/", detail.GetDescriptor()->full_name()),
                    absl::Cord(detail.SerializeAsString()));
  return status;
}

}  // namespace

absl::Status FieldViolation(const std::string& field, const std::string& description) {
  return FieldViolations({{field, description}});
}

absl::Status FieldViolations(const std::vector<Violation>& violations) {
  if (violations.empty()) return absl::OkStatus();
  google::rpc::BadRequest detail;
  std::string message;
  const size_t spelt_out = std::min(violations.size(), kMaxViolations);
  for (size_t i = 0; i < spelt_out; ++i) {
    auto* violation = detail.add_field_violations();
    violation->set_field(TextForClients(violations[i].field, kMaxFieldBytes));
    violation->set_description(TextForClients(violations[i].description, kMaxDescriptionBytes));
    absl::StrAppend(&message, i > 0 ? "; " : "", violation->field(), ": ",
                    violation->description());
  }
  if (spelt_out < violations.size()) {
    absl::StrAppend(&message, "; and ", violations.size() - spelt_out, " more");
  }
  return WithDetail(absl::InvalidArgumentError(message), detail);
}

absl::Status WithReason(absl::Status status, const std::string& reason,
                        const std::map<std::string, std::string>& metadata) {
  google::rpc::ErrorInfo detail;
  detail.set_reason(reason);
  detail.set_domain("metaekf");
  detail.mutable_metadata()->insert(metadata.begin(), metadata.end());
  return WithDetail(std::move(status), detail);
}

absl::Status WithRetryDelay(absl::Status status, absl::Duration delay) {
  google::rpc::RetryInfo detail;
  detail.mutable_retry_delay()->set_seconds(absl::ToInt64Seconds(delay));
  detail.mutable_retry_delay()->set_nanos(
      static_cast<int32_t>(absl::ToInt64Nanoseconds(delay % absl::Seconds(1))));
  return WithDetail(std::move(status), detail);
}

absl::Status WithResource(absl::Status status, const std::string& type, const std::string& name) {
  google::rpc::ResourceInfo detail;
  detail.set_resource_type(type);
  detail.set_resource_name(TextForClients(name, kMaxDescriptionBytes));
  return WithDetail(std::move(status), detail);
}

}  // namespace metaekf::server
