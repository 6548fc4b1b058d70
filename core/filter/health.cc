#include "core/filter/health.h"

#include <algorithm>
#include <cmath>

#include "core/filter/chi_squared.h"

namespace metaekf::filter {
namespace {

constexpr int64_t kMemory = 100;             // samples
constexpr double kLowest = 0.82, kHighest = 1.17;  // (1.96/2.17)² and (1.96/1.81)²
constexpr double kTail = 0.0005;             // of the χ² test, on each side
constexpr double kWhitest = 3.29;            // of a standard normal number: the same share is beyond
constexpr int64_t kLeastPairs = 20;
constexpr double kPast = 0.9;                // λ

/// Samples that a mean over the last kMemory is worth: one with weights w (1 − w)^k has the variance of one over 2/w − 1 samples; a
/// plain mean that of one over all.
double Effective(int64_t samples) { return samples < kMemory ? static_cast<double>(samples) : 2.0 * kMemory - 1; }

}  // namespace

NisMonitor::NisMonitor(Eigen::Index outputs) : past(Eigen::VectorXd::Zero(outputs)) {}

void NisMonitor::Add(double sample_nis, int sample_measured, const Eigen::Ref<const Eigen::VectorXd>& whitened) {
  samples = std::min(samples + 1, kMemory);
  const double weight = 1 / static_cast<double>(samples);
  nis += weight * (sample_nis - nis);
  measured += weight * (sample_measured - measured);
  if (whitened.size() == 0) return;
  if (!past.isZero(0)) {
    pairs = std::min(pairs + 1, kMemory);
    const double share = 1 / static_cast<double>(pairs);
    correlation += share * (whitened.dot(past) - correlation);
    past_square += share * (past.squaredNorm() - past_square);
  }
  past = kPast * past + whitened;
}

bool NisMonitor::Correlated() const {
  if (pairs < kLeastPairs || !(nis > 0) || !(past_square > 0)) return false;
  return correlation * std::sqrt(Effective(pairs) * static_cast<double>(past.size()) / (nis * past_square)) > kWhitest;
}

Health NisMonitor::Judge() const {
  if (samples == 0) return Health::kConsistent;
  if (Correlated()) return Health::kOverconfident;
  const double ratio = Ratio();
  if (ratio >= kLowest && ratio <= kHighest) return Health::kConsistent;
  const double dof = std::max(1.0, Effective(samples) * measured);
  const double beyond = ChiSquaredTail(ratio * dof, dof);
  if (ratio > kHighest && beyond < kTail) return Health::kOverconfident;
  if (ratio < kLowest && 1 - beyond < kTail) return Health::kUnderconfident;
  return Health::kConsistent;
}

}  // namespace metaekf::filter
