#pragma once

#include <map>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/time/time.h"

/// Details that programs can read, carried by an absl::Status as payloads (google.rpc messages)
/// until ToGrpcStatus sends them. No gRPC here: any part of the server may use it.
namespace metaekf::server {

/// One wrong field of a request.
struct Violation {
  std::string field;        ///< path from the request's root, e.g. "header.spec.model.case"
  std::string description;  ///< what was found, what was expected, what to do
};

/// InvalidArgument for one wrong field; message "FIELD: DESCRIPTION".
absl::Status FieldViolation(const std::string& field, const std::string& description);

/// InvalidArgument for all of `violations`, the first eight spelt out; OK if there are none.
absl::Status FieldViolations(const std::vector<Violation>& violations);

/// `status` with a reason for programs (google.rpc.ErrorInfo of domain "metaekf"),
/// e.g. SEQUENCE_GAP with {expected_seq: 7}.
absl::Status WithReason(absl::Status status, const std::string& reason,
                        const std::map<std::string, std::string>& metadata);

/// `status` with the time after which trying again makes sense (google.rpc.RetryInfo).
absl::Status WithRetryDelay(absl::Status status, absl::Duration delay);

/// `status` with the resource it is about (google.rpc.ResourceInfo): ("model", "models/robot").
absl::Status WithResource(absl::Status status, const std::string& type, const std::string& name);

}  // namespace metaekf::server
