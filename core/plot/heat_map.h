#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

#include "absl/status/statusor.h"

namespace metaekf::plot {

/// A matrix as coloured cells with their values written in: light is small, dark is great.
struct HeatMap {
  std::string title;
  std::string x_label;
  std::vector<std::string> columns, rows;
  Eigen::MatrixXd values;  ///< rows × columns; what is not finite, or has no logarithm, stays blank
  bool logarithmic = false;  ///< the colour scale
  /// Rows from the first whose values span the colour scale, 0 all; what lies beyond has the scale's end.
  Eigen::Index scale_rows = 0;
};

/// `map` as an SVG document of its own. Same map, same text.
/// Errors: InvalidArgument if names and values differ in number, or there is no cell.
absl::StatusOr<std::string> RenderSvg(const HeatMap& map);

}  // namespace metaekf::plot
