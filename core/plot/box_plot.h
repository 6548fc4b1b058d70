#pragma once

#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/plot/svg.h"

namespace metaekf::plot {

/// A distribution: the box from the lower to the upper quartile, a line at the median, whiskers that hold 99 % of the values.
struct Box {
  std::string label;
  std::vector<double> values;  ///< in any order; what an axis cannot show does not count
  Colour colour = Colour::kAutomatic;
};

/// Distributions side by side, as rows over one axis.
struct BoxPlot {
  std::string title;
  std::string x_label;  ///< with its unit
  bool logarithmic = false;
  std::vector<Box> boxes;
};

/// `plot` as an SVG document of its own. Same plot, same text. Errors: InvalidArgument if there is no box.
absl::StatusOr<std::string> RenderSvg(const BoxPlot& plot);

}  // namespace metaekf::plot
