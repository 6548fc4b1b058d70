#pragma once

#include <cstddef>
#include <string>
#include <string_view>
#include <vector>

#include "absl/status/statusor.h"

namespace metaekf::cli {

/// A numeric array of a MAT file, column by column.
struct MatArray {
  std::string name;
  size_t rows = 0, columns = 0;
  bool is_single = false;  // printed as such: 0.1f is 0.1, and times stay even
  std::vector<double> values;
};

/// Whether these bytes begin as a MAT file of version 5.
bool IsMat5(std::string_view bytes);

/// Reads the matrices of numbers in a MAT file of version 5, compressed or not, of either byte order. Scalars, text, structures,
/// sparse and nameless arrays are passed over.
///
/// Ours, because matio makes room for what a file says before it looks what is there (gigabytes for some hundred bytes), and
/// reads zeros where a file is cut off.
///
/// Errors: InvalidArgument where the file is cut off or damaged, and for a complex array, or one that does not hold what it says.
/// Source: "MAT-File Level 5 Format", The MathWorks, 2023.
absl::StatusOr<std::vector<MatArray>> ReadMat5(std::string_view bytes);

}  // namespace metaekf::cli
