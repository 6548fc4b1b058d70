#pragma once

#include <string>

#include "client/cli/records.h"

namespace metaekf::cli {

/// A job in one line of a list.
Record JobSummary(const client::Job& job);
/// All of it.
Record JobDetails(const client::Job& job);

/// Shows a job's progress until it has ended, then prints it. Errors: FailedPrecondition if it
/// failed or was cancelled.
absl::Status WatchJob(Console& console, const std::string& id);

}  // namespace metaekf::cli
