#include "core/plot/decimate.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace metaekf::plot {

std::vector<size_t> Decimate(const std::vector<double>& x, const std::vector<double>& y,
                             size_t most) {
  const size_t count = x.size();
  std::vector<size_t> kept;
  if (count <= most) {
    kept.resize(count);
    std::iota(kept.begin(), kept.end(), size_t{0});
    return kept;
  }
  const size_t stretches = most / 4;
  for (size_t stretch = 0; stretch < stretches; ++stretch) {
    const size_t begin = count * stretch / stretches;
    const size_t end = count * (stretch + 1) / stretches;
    std::vector<size_t> finite;
    for (size_t i = begin; i < end; ++i) {
      if (std::isfinite(x[i]) && std::isfinite(y[i])) finite.push_back(i);
    }
    if (finite.empty()) {
      kept.push_back(begin);
      continue;
    }
    const auto by = [](const std::vector<double>& values) {
      return [&values](size_t a, size_t b) { return values[a] < values[b]; };
    };
    const auto [left, right] = std::minmax_element(finite.begin(), finite.end(), by(x));
    const auto [lowest, highest] = std::minmax_element(finite.begin(), finite.end(), by(y));
    std::vector<size_t> extremes = {*left, *right, *lowest, *highest};
    std::sort(extremes.begin(), extremes.end());
    extremes.erase(std::unique(extremes.begin(), extremes.end()), extremes.end());
    kept.insert(kept.end(), extremes.begin(), extremes.end());
  }
  return kept;
}

}  // namespace metaekf::plot
