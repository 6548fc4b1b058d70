#pragma once

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "core/plot/svg.h"

namespace metaekf::cli {

/// The curve of one quantity: what was measured or is true, what was predicted or estimated, and
/// how sure that is. Empty vectors are not there.
struct Curve {
  std::string name, unit;
  std::string measured_label = "measured";
  std::vector<double> measured;
  std::string estimate_label = "predicted";
  std::vector<double> estimate;
  std::vector<double> std_dev;
};

/// One panel per quantity over the same times; a standard deviation shows as a band of ±2σ.
absl::Status WritePlot(const std::string& title, const std::vector<double>& times_s,
                       const std::vector<Curve>& curves, const std::string& path);

}  // namespace metaekf::cli
