#pragma once

#include <string>
#include <vector>

#include "client/cli/data_files.h"
#include "client/cli/records.h"

namespace metaekf::cli {

/// An adaptation in one line of a list.
Record AdaptationSummary(const client::Adaptation& adaptation);

/// Prints what an adaptation did: the summary, and the errors on the held-out tail before and after
/// it and of linear ARX, one row per output.
void PrintReceipt(Console& console, const client::Adaptation& adaptation, const TargetModel& model);

/// What the free-run errors on the tail mean, in words.
std::string Verdict(const client::Adaptation& adaptation);

}  // namespace metaekf::cli
