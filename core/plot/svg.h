#pragma once

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace metaekf::plot {

/// Colours that colour-blind readers can tell apart (Okabe and Ito, 2008).
enum class Colour {
  kAutomatic,  ///< the n-th series or band of a panel takes the n-th of those below but black
  kBlue,
  kVermilion,
  kGreen,
  kPurple,
  kOrange,
  kSky,
  kBlack,
};

enum class Mark { kLine, kDashes, kPoints };

/// A curve. Values that are not finite, and on a logarithmic axis those that are not positive, are
/// gaps.
struct Series {
  std::string label;  ///< in the legend; empty: not there
  std::vector<double> x, y;
  Mark mark = Mark::kLine;
  Colour colour = Colour::kAutomatic;
};

/// The area between two curves, e.g. an estimate ± 2σ; drawn pale, below the series.
struct Band {
  std::string label;
  std::vector<double> x, lower, upper;
  Colour colour = Colour::kAutomatic;
};

/// One plot. Its y axis shows all series; a band stretches it by at most half their range on either
/// side and is cut off beyond, so that a wide first uncertainty does not flatten the curves.
struct Panel {
  std::string title;
  std::string y_label;  ///< with its unit, e.g. "displacement (mm)"
  bool logarithmic_y = false;
  std::vector<Band> bands;
  std::vector<Series> series;
};

/// Panels one below the other, with one x axis.
struct Figure {
  std::string title;
  std::string x_label;  ///< with its unit
  bool logarithmic_x = false;
  std::vector<Panel> panels;
  double width_px = 900;
  double panel_height_px = 210;  ///< of the plot area of each
};

/// `figure` as an SVG document of its own: no scripts, fonts or links. A curve of more than 2000
/// points is drawn by its extremes (see Decimate). Same figure, same text.
///
/// Errors: InvalidArgument without a panel, or if x and y of a curve differ in length.
absl::StatusOr<std::string> RenderSvg(const Figure& figure);

/// The same, to a file. Errors: also NotFound if it cannot be opened, DataLoss if writing fails.
absl::Status WriteSvgFile(const Figure& figure, const std::string& path);

}  // namespace metaekf::plot
