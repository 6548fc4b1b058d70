#pragma once

#include <string>

#include "absl/status/statusor.h"

namespace metaekf::cli {

/// Whether a path ends as those of MAT files do.
bool IsMatFile(const std::string& path);

/// Reads a MAT file (version 5 or 7.3, as MATLAB and SciPy write them) as the project's CSV, to be read as such.
///
/// Every numeric array with as many rows, or columns, as there are samples becomes a column of its name; one with k values per
/// sample becomes k columns, `u` then `u1` … `uk`, and `u`, `y` and `x` alone `u1`, `y1` and `x1`. Scalars, text and structures
/// are left out: they are no signals.
///
/// Errors: NotFound; InvalidArgument naming the array for a complex one or one of another length, and for a file that is none.
absl::StatusOr<std::string> ReadMatFileAsCsv(const std::string& path);

}  // namespace metaekf::cli
