#include "core/plot/curves.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "core/plot/decimate.h"
#include "core/plot/elements.h"

namespace metaekf::plot {
namespace {

constexpr size_t kMostPoints = 2000;

bool Drawable(const Area& area, double x, double y) {
  return IsShown(x, area.x.logarithmic) && IsShown(y, area.y.logarithmic);
}

}  // namespace

void DrawSeries(const Area& area, const Series& series, const char* colour, std::string& svg) {
  const std::vector<size_t> indices = Decimate(series.x, series.y, kMostPoints);
  if (series.mark == Mark::kPoints) {
    absl::StrAppend(&svg, "<g fill=\"", colour, "\">\n");
    for (const size_t i : indices) {
      if (!Drawable(area, series.x[i], series.y[i])) continue;
      absl::StrAppend(&svg, "<circle cx=\"", Number(area.X(series.x[i])), "\" cy=\"",
                      Number(area.Y(series.y[i])), "\" r=\"2\"/>\n");
    }
    svg += "</g>\n";
    return;
  }
  std::string path;
  bool pen_down = false;
  for (size_t k = 0; k < indices.size(); ++k) {
    const size_t i = indices[k];
    const bool drawable = Drawable(area, series.x[i], series.y[i]);
    if (drawable) {
      absl::StrAppend(&path, pen_down ? "L" : "M", Number(area.X(series.x[i])), " ",
                      Number(area.Y(series.y[i])));
      // A value between two gaps would have no length: a stroke of none shows as a round dot.
      const bool lonely =
          !pen_down && (k + 1 == indices.size() ||
                        !Drawable(area, series.x[indices[k + 1]], series.y[indices[k + 1]]));
      if (lonely) path += "h0";
    }
    pen_down = drawable;
  }
  absl::StrAppend(&svg, "<path d=\"", path, "\" fill=\"none\" stroke=\"", colour, "\" class=\"curve\"",
                  series.mark == Mark::kDashes ? " stroke-dasharray=\"6 4\"" : "", "/>\n");
}

void DrawBand(const Area& area, const Band& band, const char* colour, std::string& svg) {
  const size_t count = band.x.size();
  const size_t stride = std::max<size_t>(1, (count + kMostPoints / 2 - 1) / (kMostPoints / 2));
  const double floor = area.y.low;
  std::string upper_edge, lower_edge, path;
  const auto close = [&] {
    if (!upper_edge.empty()) absl::StrAppend(&path, "M", upper_edge.substr(1), lower_edge, "Z");
    upper_edge.clear();
    lower_edge.clear();
  };
  for (size_t begin = 0; begin < count; begin += stride) {
    Range range;
    double position = 0;
    for (size_t i = begin; i < std::min(begin + stride, count); ++i) {
      if (!Drawable(area, band.x[i], band.upper[i]) || !IsShown(band.lower[i], false)) continue;
      position = band.x[i];
      // A lower edge at or below zero has no logarithm: it runs along the bottom.
      range.Add(area.y.logarithmic ? std::max(band.lower[i], floor) : band.lower[i]);
      range.Add(band.upper[i]);
    }
    if (range.empty()) {
      close();
      continue;
    }
    const std::string x = Number(area.X(position));
    // Beyond the plot the exact height does not matter, and numbers stay short.
    const auto y = [&area](double value) {
      return Number(std::clamp(area.Y(value), area.top - 1e3, area.top + area.height + 1e3));
    };
    absl::StrAppend(&upper_edge, "L", x, " ", y(range.max));
    lower_edge = absl::StrCat("L", x, " ", y(range.min), lower_edge);
  }
  close();
  absl::StrAppend(&svg, "<path d=\"", path, "\" fill=\"", colour,
                  "\" fill-opacity=\"0.2\" stroke=\"none\"/>\n");
}

}  // namespace metaekf::plot
