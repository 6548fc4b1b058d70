#pragma once

#include <cmath>
#include <limits>
#include <string>

#include "core/plot/axis.h"
#include "core/plot/svg.h"

namespace metaekf::plot {

/// Whether an axis can show a value: it is finite, positive if the axis is logarithmic, and so far
/// from the limits of double that ranges and ratios of such values are numbers as well.
inline bool IsShown(double value, bool logarithmic) {
  return std::abs(value) < 1e300 && (!logarithmic || value > 1e-300);
}

/// Smallest and greatest of the finite values given to it.
struct Range {
  double min = std::numeric_limits<double>::infinity();
  double max = -std::numeric_limits<double>::infinity();

  void Add(double value) {
    min = std::min(min, value);
    max = std::max(max, value);
  }
  bool empty() const { return min > max; }
};

/// The plot area of a panel, and its scales.
struct Area {
  double left, top, width, height;
  Axis x, y;

  double X(double value) const { return left + width * x.Position(value); }
  double Y(double value) const { return top + height * (1 - y.Position(value)); }
};

/// Appends a series. A value between two gaps shows as a dot.
void DrawSeries(const Area& area, const Series& series, const char* colour, std::string& svg);

/// Appends a band, an outline for each stretch without gaps; where its lower edge has no logarithm,
/// it runs along the bottom.
void DrawBand(const Area& area, const Band& band, const char* colour, std::string& svg);

}  // namespace metaekf::plot
