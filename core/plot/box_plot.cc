#include "core/plot/box_plot.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/plot/curves.h"
#include "core/plot/elements.h"

namespace metaekf::plot {
namespace {

constexpr double kWidthPx = 560, kRowPx = 34, kBoxPx = 18, kTopPx = 42, kBottomPx = 52, kRightPx = 24;
constexpr double kWhiskerShare = 0.005;  // of the values beyond each whisker

struct Quantiles {
  double low, lower, median, upper, high;
};

/// Of the values that the axis can show; they must not be none.
Quantiles QuantilesOf(const std::vector<double>& sorted) {
  const auto at = [&sorted](double share) { return base::Quantile(sorted, share); };
  return {at(kWhiskerShare), at(0.25), at(0.5), at(0.75), at(1 - kWhiskerShare)};
}

void DrawBox(const Area& area, double middle, const Quantiles& q, const char* colour, std::string& svg) {
  const double top = middle - kBoxPx / 2, left = area.X(q.lower), right = area.X(q.upper);
  Line(area.X(q.low), middle, left, middle, colour, svg);
  Line(right, middle, area.X(q.high), middle, colour, svg);
  for (const double end : {q.low, q.high}) Line(area.X(end), middle - kBoxPx / 4, area.X(end), middle + kBoxPx / 4, colour, svg);
  absl::StrAppend(&svg, "<rect x=\"", Number(left), "\" y=\"", Number(top), "\" width=\"", Number(right - left), "\" height=\"",
                  Number(kBoxPx), "\" fill=\"", colour, "\" fill-opacity=\"0.25\" stroke=\"", colour, "\"/>\n");
  Line(area.X(q.median), top, area.X(q.median), top + kBoxPx, "#222222", svg);
}

}  // namespace

absl::StatusOr<std::string> RenderSvg(const BoxPlot& plot) {
  if (plot.boxes.empty()) return absl::InvalidArgumentError("a box plot needs a box");
  std::vector<std::vector<double>> shown;
  Range range;
  double left = 0;
  for (const Box& box : plot.boxes) {
    left = std::max(left, TextWidthPx(box.label));
    std::vector<double>& values = shown.emplace_back(box.values);
    std::erase_if(values, [&plot](double value) { return !IsShown(value, plot.logarithmic); });
    std::sort(values.begin(), values.end());
    if (values.empty()) continue;
    const Quantiles q = QuantilesOf(values);
    range.Add(q.low);
    range.Add(q.high);
  }
  if (range.empty()) range = {.min = plot.logarithmic ? 0.1 : 0, .max = 1};
  left += 24;
  const double rows = kRowPx * static_cast<double>(plot.boxes.size()), bottom = kTopPx + rows;
  const Area area{.left = left, .top = kTopPx, .width = kWidthPx, .height = rows,
                  .x = MakeAxis(range.min, range.max, plot.logarithmic, 0.03, 6), .y = {}};
  std::string svg = BeginDocument(left + kWidthPx + kRightPx, bottom + kBottomPx);
  Text(12, 24, plot.title, " font-size=\"15\" font-weight=\"bold\"", svg);
  for (const Tick& tick : area.x.ticks) {
    Line(area.X(tick.value), kTopPx, area.X(tick.value), bottom, tick.label.empty() ? "#f2f2f2" : "#e4e4e4", svg);
    Text(area.X(tick.value), bottom + 17, tick.label, " text-anchor=\"middle\"", svg);
  }
  for (size_t i = 0; i < plot.boxes.size(); ++i) {
    const double middle = kTopPx + kRowPx * (static_cast<double>(i) + 0.5);
    Text(left - 8, middle + 4, plot.boxes[i].label, " text-anchor=\"end\"", svg);
    if (!shown[i].empty()) DrawBox(area, middle, QuantilesOf(shown[i]), Hex(plot.boxes[i].colour, i), svg);
  }
  const std::string label = area.x.factor.empty() ? plot.x_label : plot.x_label + "  " + area.x.factor;
  Text(left + kWidthPx / 2, bottom + 38, label, " text-anchor=\"middle\"", svg);
  return svg + "</svg>\n";
}

}  // namespace metaekf::plot
