#include "client/cli/plots.h"

#include <utility>

namespace metaekf::cli {

absl::Status WritePlot(const std::string& title, const std::vector<double>& times_s,
                       const std::vector<Curve>& curves, const std::string& path) {
  plot::Figure figure{.title = title, .x_label = "t (s)"};
  for (const Curve& curve : curves) {
    plot::Panel panel{.y_label =
                          curve.unit.empty() ? curve.name : curve.name + " (" + curve.unit + ")"};
    if (!curve.measured.empty()) {
      panel.series.push_back({.label = curve.measured_label,
                              .x = times_s,
                              .y = curve.measured,
                              .colour = plot::Colour::kBlack});
    }
    panel.series.push_back(
        {.label = curve.estimate_label,
         .x = times_s,
         .y = curve.estimate,
         .mark = curve.measured.empty() ? plot::Mark::kLine : plot::Mark::kDashes,
         .colour = plot::Colour::kVermilion});
    if (!curve.std_dev.empty()) {
      plot::Band band{.label = "±2σ", .x = times_s, .colour = plot::Colour::kVermilion};
      for (size_t i = 0; i < curve.estimate.size(); ++i) {
        band.lower.push_back(curve.estimate[i] - 2 * curve.std_dev[i]);
        band.upper.push_back(curve.estimate[i] + 2 * curve.std_dev[i]);
      }
      panel.bands.push_back(std::move(band));
    }
    figure.panels.push_back(std::move(panel));
  }
  return plot::WriteSvgFile(figure, path);
}

}  // namespace metaekf::cli
