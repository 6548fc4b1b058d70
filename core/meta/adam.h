#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

namespace metaekf::meta {

constexpr double kAdamBeta1 = 0.9, kAdamBeta2 = 0.999, kAdamEpsilon = 1e-8;

/// 1 − β₁ᵏ and 1 − β₂ᵏ: what the moments of step k, counted from 1, are divided by for having started at zero.
struct AdamCorrections {
  explicit AdamCorrections(int64_t step)
      : first(1 - std::pow(kAdamBeta1, static_cast<double>(step))),
        second(1 - std::pow(kAdamBeta2, static_cast<double>(step))) {}
  double first, second;
};

/// Takes one component of a gradient into its moments. @return m̂ / (√v̂ + 10⁻⁸), what a step of rate 1 subtracts.
inline double AdamDirection(double gradient, const AdamCorrections& corrections, double* m, double* v) {
  *m = kAdamBeta1 * *m + (1 - kAdamBeta1) * gradient;
  *v = kAdamBeta2 * *v + (1 - kAdamBeta2) * gradient * gradient;
  return (*m / corrections.first) / (std::sqrt(*v / corrections.second) + kAdamEpsilon);
}

/// One step of Adam (Kingma and Ba, 2015) with its usual constants.
///
///   m ← 0.9 m + 0.1 g,  v ← 0.999 v + 0.001 g²,  ω ← ω − β m̂ / (√v̂ + 10⁻⁸)
///
/// with m̂ and v̂ corrected for starting at zero. @param step  counts from 1.
inline void AdamStep(const std::vector<double>& gradient, int64_t step, double learning_rate, std::vector<double>* m,
                     std::vector<double>* v, std::vector<double>* parameters) {
  const AdamCorrections corrections(step);
  for (size_t i = 0; i < gradient.size(); ++i) {
    (*parameters)[i] -= learning_rate * AdamDirection(gradient[i], corrections, &(*m)[i], &(*v)[i]);
  }
}

/// Shortens a vector to `largest` if it is longer; 0 leaves it alone. @return its length before.
inline double ClipNorm(double largest, std::vector<double>* vector) {
  double squared = 0;
  for (const double value : *vector) squared += value * value;
  const double norm = std::sqrt(squared);
  if (largest > 0 && norm > largest) {
    for (double& value : *vector) value *= largest / norm;
  }
  return norm;
}

}  // namespace metaekf::meta
