#include "core/plot/heat_map.h"

#include <algorithm>
#include <cmath>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/plot/curves.h"
#include "core/plot/elements.h"

namespace metaekf::plot {
namespace {

constexpr double kCellWidthPx = 66, kCellHeightPx = 26, kTopPx = 42, kBottomPx = 52, kRightPx = 18;

/// Share of the colour scale of every value.
class Scale {
 public:
  explicit Scale(const HeatMap& map) : logarithmic_(map.logarithmic) {
    const Eigen::Index rows = map.scale_rows > 0 ? std::min(map.scale_rows, map.values.rows()) : map.values.rows();
    for (const double value : map.values.topRows(rows).reshaped()) {
      if (IsShown(value, logarithmic_)) range_.Add(Position(value));
    }
  }
  double Share(double value) const {
    return range_.max > range_.min ? std::clamp((Position(value) - range_.min) / (range_.max - range_.min), 0.0, 1.0) : 0;
  }

 private:
  double Position(double value) const { return logarithmic_ ? std::log(value) : value; }

  bool logarithmic_;
  Range range_;
};

void DrawCell(double left, double top, double value, double share, std::string& svg) {
  absl::StrAppend(&svg, "<rect x=\"", Number(left), "\" y=\"", Number(top), "\" width=\"", Number(kCellWidthPx),
                  "\" height=\"", Number(kCellHeightPx), "\" fill=\"", ScaleColour(share), "\" stroke=\"white\"/>\n");
  const char* ink = share > 0.55 ? " text-anchor=\"middle\" style=\"fill:white\"" : " text-anchor=\"middle\"";
  Text(left + kCellWidthPx / 2, top + kCellHeightPx / 2 + 4, base::FormatShort(value, 3), ink, svg);
}

}  // namespace

absl::StatusOr<std::string> RenderSvg(const HeatMap& map) {
  const auto rows = static_cast<Eigen::Index>(map.rows.size()), columns = static_cast<Eigen::Index>(map.columns.size());
  if (map.values.size() == 0 || map.values.rows() != rows || map.values.cols() != columns) {
    return absl::InvalidArgumentError(absl::StrCat("a heat map of ", rows, " rows and ", columns, " columns has ",
                                                   map.values.rows(), " × ", map.values.cols(), " values"));
  }
  double left = 0;
  for (const std::string& name : map.rows) left = std::max(left, TextWidthPx(name));
  left += 24;
  const double width = left + kCellWidthPx * static_cast<double>(columns) + kRightPx;
  const double bottom = kTopPx + kCellHeightPx * static_cast<double>(rows), height = bottom + kBottomPx;
  std::string svg = BeginDocument(width, height);
  Text(12, 24, map.title, " font-size=\"15\" font-weight=\"bold\"", svg);
  const Scale scale(map);
  for (Eigen::Index row = 0; row < rows; ++row) {
    const double top = kTopPx + kCellHeightPx * static_cast<double>(row);
    Text(left - 8, top + kCellHeightPx / 2 + 4, map.rows[static_cast<size_t>(row)], " text-anchor=\"end\"", svg);
    for (Eigen::Index column = 0; column < columns; ++column) {
      const double value = map.values(row, column);
      if (!IsShown(value, map.logarithmic)) continue;
      DrawCell(left + kCellWidthPx * static_cast<double>(column), top, value, scale.Share(value), svg);
    }
  }
  for (Eigen::Index column = 0; column < columns; ++column) {
    Text(left + kCellWidthPx * (static_cast<double>(column) + 0.5), bottom + 17, map.columns[static_cast<size_t>(column)],
         " text-anchor=\"middle\"", svg);
  }
  Text(left + kCellWidthPx * static_cast<double>(columns) / 2, bottom + 38, map.x_label, " text-anchor=\"middle\"", svg);
  return svg + "</svg>\n";
}

}  // namespace metaekf::plot
