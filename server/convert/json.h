#pragma once

#include <google/protobuf/message.h>

#include <string>

#include "absl/status/status.h"

/// Messages as the JSON that core reads and that the store keeps: fields by their .proto names,
/// enumerators by name.
namespace metaekf::server {

std::string MessageToJson(const google::protobuf::Message& message);

/// Fields that the message does not have are passed over: a later version may have written them.
/// Errors: InvalidArgument with the place.
absl::Status JsonToMessage(const std::string& json, google::protobuf::Message* message);

}  // namespace metaekf::server
