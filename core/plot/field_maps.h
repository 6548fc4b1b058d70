#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/plot/svg.h"

namespace metaekf::plot {

/// A function on a grid over a rectangle of the plane.
struct FieldMap {
  std::string title;
  Eigen::MatrixXd values;  ///< values(i, j) at the middle of cell (i, j): j along x, i along y, both ascending
};

/// Functions on the same rectangle as coloured areas, side by side, with one scale of 24 colours.
struct FieldMaps {
  std::string title;
  std::string x_label, y_label, value_label;  ///< with their units
  double x_min = 0, x_max = 1, y_min = 0, y_max = 1;
  bool logarithmic = false;
  /// Ends of the colour scale; what lies beyond has the end's colour. Equal: those of the values.
  double low = 0, high = 0;
  std::vector<FieldMap> maps;
  std::vector<Series> curves;  ///< drawn over every map, in the plane's coordinates
};

/// `maps` as an SVG document of its own; cells without a value that the scale can show stay white. Same maps, same text.
/// Errors: InvalidArgument without a map, or if one has no cell.
absl::StatusOr<std::string> RenderSvg(const FieldMaps& maps);

}  // namespace metaekf::plot
