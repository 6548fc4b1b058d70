#include "core/plot/svg.h"

#include <algorithm>
#include <cmath>
#include <fstream>

#include "core/base/status.h"
#include "core/plot/axis.h"
#include "core/plot/curves.h"
#include "core/plot/elements.h"

namespace metaekf::plot {
namespace {

constexpr double kLeftPx = 78, kRightPx = 18, kLegendRowPx = 19, kPanelGapPx = 16;
constexpr double kTitlePx = 34, kBottomPx = 52, kSwatchPx = 22, kLegendGapPx = 18;

absl::Status CheckLengths(const Figure& figure) {
  if (figure.panels.empty()) return absl::InvalidArgumentError("a figure needs a panel");
  for (const Panel& panel : figure.panels) {
    for (const Series& series : panel.series) {
      if (series.x.size() == series.y.size()) continue;
      return absl::InvalidArgumentError(absl::StrCat("series \"", series.label, "\" has ",
                                                     series.x.size(), " values of x and ",
                                                     series.y.size(), " of y"));
    }
    for (const Band& band : panel.bands) {
      if (band.x.size() == band.lower.size() && band.x.size() == band.upper.size()) continue;
      return absl::InvalidArgumentError(
          absl::StrCat("band \"", band.label, "\" has ", band.x.size(), " values of x, ",
                       band.lower.size(), " below and ", band.upper.size(), " above"));
    }
  }
  return absl::OkStatus();
}

Axis XAxis(const Figure& figure, double width_px) {
  const int ticks = static_cast<int>(width_px / 100) + 1;
  Range range;
  const bool logarithmic = figure.logarithmic_x;
  const auto add = [&range, logarithmic](const std::vector<double>& values) {
    for (const double value : values) {
      if (IsShown(value, logarithmic)) range.Add(value);
    }
  };
  for (const Panel& panel : figure.panels) {
    for (const Series& series : panel.series) add(series.x);
    for (const Band& band : panel.bands) add(band.x);
  }
  if (range.empty()) return MakeAxis(logarithmic ? 0.1 : 0, 1, logarithmic, 0, ticks);
  return MakeAxis(range.min, range.max, logarithmic, logarithmic ? 0.02 : 0, ticks);
}

Axis YAxis(const Panel& panel) {
  const bool logarithmic = panel.logarithmic_y;
  const auto add = [logarithmic](const std::vector<double>& values, Range& range) {
    for (const double value : values) {
      if (IsShown(value, logarithmic)) range.Add(logarithmic ? std::log10(value) : value);
    }
  };
  Range curves, bands;
  for (const Series& series : panel.series) add(series.y, curves);
  for (const Band& band : panel.bands) {
    add(band.lower, bands);
    add(band.upper, bands);
  }
  if (!curves.empty() && !bands.empty()) {
    const double reach = 0.5 * (curves.max - curves.min);
    bands.min = std::max(bands.min, curves.min - reach);
    bands.max = std::min(bands.max, curves.max + reach);
    curves.Add(std::min(bands.min, curves.max));
    curves.Add(std::max(bands.max, curves.min));
  }
  if (curves.empty()) curves = bands;
  if (curves.empty()) return MakeAxis(logarithmic ? 0.1 : 0, 1, logarithmic, 0, 5);
  if (!logarithmic) return MakeAxis(curves.min, curves.max, false, 0.05, 5);
  return MakeAxis(std::pow(10, curves.min), std::pow(10, curves.max), true, 0.05, 5);
}

void DrawAxes(const Area& area, const Panel& panel, bool last, const std::string& x_label,
              std::string& svg) {
  const double bottom = area.top + area.height, right = area.left + area.width;
  for (const Tick& tick : area.x.ticks) {
    const double x = area.X(tick.value);
    Line(x, area.top, x, bottom, "#e4e4e4", svg);
    if (last) Text(x, bottom + 17, tick.label, " text-anchor=\"middle\"", svg);
  }
  for (const Tick& tick : area.y.ticks) {
    const double y = area.Y(tick.value);
    Line(area.left, y, right, y, tick.label.empty() ? "#f2f2f2" : "#e4e4e4", svg);
    Text(area.left - 7, y + 4, tick.label, " text-anchor=\"end\"", svg);
  }
  absl::StrAppend(&svg, "<rect x=\"", Number(area.left), "\" y=\"", Number(area.top), "\" width=\"",
                  Number(area.width), "\" height=\"", Number(area.height),
                  "\" stroke=\"#888888\"/>\n");
  const std::string y_label =
      area.y.factor.empty() ? panel.y_label : panel.y_label + "  " + area.y.factor;
  UprightText(18, area.top + area.height / 2, y_label, svg);
  if (!last) return;
  const std::string label = area.x.factor.empty() ? x_label : x_label + "  " + area.x.factor;
  Text(area.left + area.width / 2, bottom + 38, label, " text-anchor=\"middle\"", svg);
}

/// A sample of a mark and its label.
struct LegendEntry {
  std::string label;
  const char* colour;
  bool band;
  Mark mark;
};

std::vector<LegendEntry> Legend(const Panel& panel) {
  std::vector<LegendEntry> entries;
  for (size_t i = 0; i < panel.series.size(); ++i) {
    const Series& series = panel.series[i];
    if (!series.label.empty()) {
      entries.push_back({series.label, Hex(series.colour, i), false, series.mark});
    }
  }
  for (size_t i = 0; i < panel.bands.size(); ++i) {
    const Band& band = panel.bands[i];
    if (!band.label.empty())
      entries.push_back({band.label, Hex(band.colour, i), true, Mark::kLine});
  }
  return entries;
}

void DrawLegendEntry(const LegendEntry& entry, double left, double top, std::string& svg) {
  const std::string from = Number(left), middle = Number(top + 9);
  if (entry.band) {
    absl::StrAppend(&svg, "<rect x=\"", from, "\" y=\"", Number(top + 3), "\" width=\"",
                    Number(kSwatchPx), "\" height=\"12\" fill=\"", entry.colour,
                    "\" fill-opacity=\"0.2\"/>\n");
  } else if (entry.mark == Mark::kPoints) {
    absl::StrAppend(&svg, "<circle cx=\"", Number(left + kSwatchPx / 2), "\" cy=\"", middle,
                    "\" r=\"2.5\" fill=\"", entry.colour, "\"/>\n");
  } else {
    absl::StrAppend(&svg, "<path class=\"curve\" d=\"M", from, " ", middle, "h", Number(kSwatchPx),
                    "\" stroke=\"", entry.colour, "\"",
                    entry.mark == Mark::kDashes ? " stroke-dasharray=\"6 4\"" : "", "/>\n");
  }
  Text(left + kSwatchPx + 6, top + 13, entry.label, "", svg);
}

/// Writes title and legend from `top` on, in as many rows as they need; returns their height.
double DrawHeader(const Panel& panel, double top, double width, std::string& svg) {
  const std::vector<LegendEntry> entries = Legend(panel);
  if (panel.title.empty() && entries.empty()) return 6;
  double x = 0, y = top;
  if (!panel.title.empty()) {
    Text(kLeftPx, top + 13, panel.title, " font-weight=\"bold\"", svg);
    x = 1.15 * TextWidthPx(panel.title) + kLegendGapPx;
  }
  for (const LegendEntry& entry : entries) {
    const double entry_width = kSwatchPx + 6 + TextWidthPx(entry.label);
    if (x > 0 && x + entry_width > width) {
      x = 0;
      y += kLegendRowPx;
    }
    DrawLegendEntry(entry, kLeftPx + x, y, svg);
    x += entry_width + kLegendGapPx;
  }
  return y + kLegendRowPx - top + 3;
}

void DrawPanel(const Panel& panel, const Area& area, size_t index, std::string& svg) {
  const std::string clip = absl::StrCat("plot", index);
  absl::StrAppend(&svg, "<clipPath id=\"", clip, "\"><rect x=\"", Number(area.left), "\" y=\"",
                  Number(area.top), "\" width=\"", Number(area.width), "\" height=\"",
                  Number(area.height), "\"/></clipPath>\n<g clip-path=\"url(#", clip, ")\">\n");
  for (size_t i = 0; i < panel.bands.size(); ++i) {
    DrawBand(area, panel.bands[i], Hex(panel.bands[i].colour, i), svg);
  }
  for (size_t i = 0; i < panel.series.size(); ++i) {
    DrawSeries(area, panel.series[i], Hex(panel.series[i].colour, i), svg);
  }
  svg += "</g>\n";
}

}  // namespace

absl::StatusOr<std::string> RenderSvg(const Figure& figure) {
  METAEKF_RETURN_IF_ERROR(CheckLengths(figure));
  const double width = figure.width_px - kLeftPx - kRightPx;
  const Axis x_axis = XAxis(figure, width);
  double top = figure.title.empty() ? 8 : kTitlePx;
  std::string body;
  for (size_t i = 0; i < figure.panels.size(); ++i) {
    const Panel& panel = figure.panels[i];
    top += DrawHeader(panel, top, width, body);
    const Area area{kLeftPx, top, width, figure.panel_height_px, x_axis, YAxis(panel)};
    DrawAxes(area, panel, i + 1 == figure.panels.size(), figure.x_label, body);
    DrawPanel(panel, area, i, body);
    top += figure.panel_height_px + kPanelGapPx;
  }
  const double height = top - kPanelGapPx + kBottomPx;
  const std::string size = absl::StrCat(Number(figure.width_px), " ", Number(height));
  std::string svg = absl::StrCat(
      "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"", Number(figure.width_px), "\" height=\"",
      Number(height), "\" viewBox=\"0 0 ", size,
      "\" font-family=\"DejaVu Sans, Helvetica, Arial, sans-serif\" font-size=\"12\" "
      "fill=\"none\">\n"
      "<style>text{fill:#222222}.curve{stroke-width:1.5;stroke-linejoin:round;"
      "stroke-linecap:round}</style>\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n");
  if (!figure.title.empty()) {
    Text(kLeftPx, 22, figure.title, " font-size=\"15\" font-weight=\"bold\"", svg);
  }
  return svg + body + "</svg>\n";
}

absl::Status WriteSvgFile(const Figure& figure, const std::string& path) {
  METAEKF_ASSIGN_OR_RETURN(const std::string svg, RenderSvg(figure));
  std::ofstream file(path, std::ios::binary);
  if (!file) return absl::NotFoundError(absl::StrCat("cannot write ", path));
  file << svg;
  file.close();
  if (!file)
    return absl::DataLossError(absl::StrCat("writing ", path, " failed; is the disk full?"));
  return absl::OkStatus();
}

}  // namespace metaekf::plot
