#pragma once

#include <string>
#include <vector>

#include "client/cli/console.h"

namespace metaekf::cli {

/// Runs the command line with `arguments` (without the program's name) on the console's streams.
/// @return 0 done, 1 failed, 2 wrong usage.
int Run(const std::vector<std::string>& arguments, Console& console);

}  // namespace metaekf::cli
