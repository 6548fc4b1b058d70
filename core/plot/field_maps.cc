#include "core/plot/field_maps.h"

#include <algorithm>
#include <cmath>

#include "absl/strings/str_cat.h"
#include "core/plot/curves.h"
#include "core/plot/elements.h"

namespace metaekf::plot {
namespace {

using Eigen::Index;

constexpr double kMapPx = 300, kGapPx = 26, kLeftPx = 66, kTopPx = 66, kBottomPx = 52, kBarPx = 16, kBarLabelsPx = 92;
constexpr int kColours = 24;
constexpr int kBlank = -1;
constexpr char kWithoutSeams[] = "<g shape-rendering=\"crispEdges\">\n";  // of smoothed edges between cells

/// The step of the colour scale that a value has, kBlank if it has none.
int StepOf(double value, const Axis& scale) {
  if (!IsShown(value, scale.logarithmic)) return kBlank;
  return static_cast<int>(std::clamp(scale.Position(value), 0.0, 1.0) * (kColours - 1) + 0.5);
}

std::string ColourOf(int step) { return ScaleColour(static_cast<double>(step) / (kColours - 1)); }

Axis ColourScale(const FieldMaps& maps) {
  Range range;
  for (const FieldMap& map : maps.maps) {
    for (const double value : map.values.reshaped()) {
      if (IsShown(value, maps.logarithmic)) range.Add(value);
    }
  }
  if (maps.low < maps.high) range = {.min = maps.low, .max = maps.high};
  if (range.empty()) range = {.min = maps.logarithmic ? 0.1 : 0, .max = 1};
  return MakeAxis(range.min, range.max, maps.logarithmic, 0, 5);
}

/// Cells of a row that share a colour are one rectangle.
void DrawCells(const FieldMap& map, const Area& area, const Axis& scale, std::string& svg) {
  const Index rows = map.values.rows(), columns = map.values.cols();
  const double width = area.width / static_cast<double>(columns), height = area.height / static_cast<double>(rows);
  svg += kWithoutSeams;
  for (Index row = 0; row < rows; ++row) {
    const double top = area.top + height * static_cast<double>(rows - 1 - row);
    for (Index first = 0, next = 0; first < columns; first = next) {
      const int step = StepOf(map.values(row, first), scale);
      while (next < columns && StepOf(map.values(row, next), scale) == step) ++next;
      if (step == kBlank) continue;
      absl::StrAppend(&svg, "<rect x=\"", Number(area.left + width * static_cast<double>(first)), "\" y=\"", Number(top), "\" width=\"",
                      Number(width * static_cast<double>(next - first)), "\" height=\"", Number(height), "\" fill=\"", ColourOf(step), "\"/>\n");
    }
  }
  svg += "</g>\n";
}

void DrawColourBar(const Area& area, const std::string& label, std::string& svg) {
  const double step = area.height / kColours;
  svg += kWithoutSeams;
  for (int i = 0; i < kColours; ++i) {
    absl::StrAppend(&svg, "<rect x=\"", Number(area.left), "\" y=\"", Number(area.top + step * (kColours - 1 - i)), "\" width=\"", Number(kBarPx),
                    "\" height=\"", Number(step), "\" fill=\"", ColourOf(i), "\"/>\n");
  }
  svg += "</g>\n";
  for (const Tick& tick : area.y.ticks) {
    if (!tick.label.empty()) Text(area.left + kBarPx + 6, area.Y(tick.value) + 4, tick.label, "", svg);
  }
  Text(area.left, area.top - 10, area.y.factor.empty() ? label : label + "  " + area.y.factor, "", svg);
}

}  // namespace

absl::StatusOr<std::string> RenderSvg(const FieldMaps& maps) {
  if (maps.maps.empty()) return absl::InvalidArgumentError("maps of a field need a map");
  const Axis scale = ColourScale(maps);
  const double aspect = (maps.y_max - maps.y_min) / (maps.x_max - maps.x_min), map_height = kMapPx * aspect;
  const auto count = static_cast<double>(maps.maps.size());
  const double bar = kLeftPx + count * (kMapPx + kGapPx), bottom = kTopPx + map_height;
  std::string svg = BeginDocument(bar + kBarPx + std::max(kBarLabelsPx, TextWidthPx(maps.value_label)), bottom + kBottomPx);
  Text(12, 24, maps.title, " font-size=\"15\" font-weight=\"bold\"", svg);
  Area area{.left = kLeftPx, .top = kTopPx, .width = kMapPx, .height = map_height,
            .x = MakeAxis(maps.x_min, maps.x_max, false, 0, 5), .y = MakeAxis(maps.y_min, maps.y_max, false, 0, 5)};
  for (const FieldMap& map : maps.maps) {
    if (map.values.size() == 0) return absl::InvalidArgumentError(absl::StrCat("map \"", map.title, "\" has no cell"));
    Text(area.left, kTopPx - 10, map.title, "", svg);
    DrawCells(map, area, scale, svg);
    for (const Series& curve : maps.curves) DrawSeries(area, curve, Hex(curve.colour, 0), svg);
    for (const Tick& tick : area.x.ticks) Text(area.X(tick.value), bottom + 17, tick.label, " text-anchor=\"middle\"", svg);
    Text(area.left + kMapPx / 2, bottom + 38, maps.x_label, " text-anchor=\"middle\"", svg);
    area.left += kMapPx + kGapPx;
  }
  area.left = kLeftPx;
  for (const Tick& tick : area.y.ticks) Text(kLeftPx - 6, area.Y(tick.value) + 4, tick.label, " text-anchor=\"end\"", svg);
  UprightText(18, kTopPx + map_height / 2, maps.y_label, svg);
  DrawColourBar({.left = bar, .top = kTopPx, .width = kBarPx, .height = map_height, .x = {}, .y = scale}, maps.value_label, svg);
  return svg + "</svg>\n";
}

}  // namespace metaekf::plot
