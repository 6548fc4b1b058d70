#pragma once

#include <string>

#include "absl/status/status.h"
#include "server/options.h"

namespace metaekf::server {

/// Puts what the text of a configuration file says over `options`.
/// Errors: InvalidArgument with line and column, or the field and what is wrong with it.
absl::Status ApplyConfig(const std::string& text, ServerOptions* options);

/// As ApplyConfig, from a file. Errors: also NotFound, FailedPrecondition; all name the file.
absl::Status ReadConfigFile(const std::string& path, ServerOptions* options);

}  // namespace metaekf::server
