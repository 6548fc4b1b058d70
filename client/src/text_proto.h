#pragma once

#include <google/protobuf/message.h>

#include <string>

#include "metaekf/client.h"

namespace metaekf::client {

/// Reads protobuf text into `message`. Errors: InvalidArgument with "SOURCE:LINE:COLUMN: …" for the
/// first thing that is wrong; for a field that does not exist, with those that do.
Status ParseText(const std::string& text, const std::string& source,
                 google::protobuf::Message* message);

/// `message` as protobuf text.
std::string PrintText(const google::protobuf::Message& message);

}  // namespace metaekf::client
