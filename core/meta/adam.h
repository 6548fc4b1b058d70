#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

namespace metaekf::meta {

/// One step of Adam (Kingma and Ba, 2015) with its usual constants.
///
///   m ← 0.9 m + 0.1 g,  v ← 0.999 v + 0.001 g²,  ω ← ω − β m̂ / (√v̂ + 10⁻⁸)
///
/// with m̂ and v̂ corrected for starting at zero. @param step  counts from 1.
inline void AdamStep(const std::vector<double>& gradient, int64_t step, double learning_rate, std::vector<double>* m,
                     std::vector<double>* v, std::vector<double>* parameters) {
  constexpr double kBeta1 = 0.9, kBeta2 = 0.999, kEpsilon = 1e-8;
  const double correction1 = 1 - std::pow(kBeta1, static_cast<double>(step));
  const double correction2 = 1 - std::pow(kBeta2, static_cast<double>(step));
  for (size_t i = 0; i < gradient.size(); ++i) {
    (*m)[i] = kBeta1 * (*m)[i] + (1 - kBeta1) * gradient[i];
    (*v)[i] = kBeta2 * (*v)[i] + (1 - kBeta2) * gradient[i] * gradient[i];
    (*parameters)[i] -= learning_rate * ((*m)[i] / correction1) / (std::sqrt((*v)[i] / correction2) + kEpsilon);
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
