#include "core/filter/health.h"

#include <algorithm>

#include "core/filter/chi_squared.h"

namespace metaekf::filter {
namespace {

constexpr int64_t kMemory = 100;             // samples
constexpr double kLowest = 0.82, kHighest = 1.17;  // (1.96/2.17)² and (1.96/1.81)²
constexpr double kTail = 0.0005;             // of the χ² test, on each side

}  // namespace

void NisMonitor::Add(double sample_nis, int sample_measured) {
  samples = std::min(samples + 1, kMemory);
  const double weight = 1 / static_cast<double>(samples);
  nis += weight * (sample_nis - nis);
  measured += weight * (sample_measured - measured);
}

Health NisMonitor::Judge() const {
  if (samples == 0) return Health::kConsistent;
  const double ratio = Ratio();
  if (ratio >= kLowest && ratio <= kHighest) return Health::kConsistent;
  // A mean with weights w (1 − w)^k has the variance of one over 2/w − 1 samples; a plain mean that of one over all.
  const double effective = samples < kMemory ? static_cast<double>(samples) : 2.0 * kMemory - 1;
  const double dof = std::max(1.0, effective * measured);
  const double beyond = ChiSquaredTail(ratio * dof, dof);
  if (ratio > kHighest && beyond < kTail) return Health::kOverconfident;
  if (ratio < kLowest && 1 - beyond < kTail) return Health::kUnderconfident;
  return Health::kConsistent;
}

}  // namespace metaekf::filter
