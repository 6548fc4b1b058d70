#include "core/filter/chi_squared.h"

#include <cmath>
#include <numbers>

namespace metaekf::filter {
namespace {

constexpr double kManyDof = 100;

/// (χ²_ν/ν)^⅓ is nearly normal, with mean 1 − 2/(9ν) and variance 2/(9ν).
double WilsonHilfertyTail(double x, double dof) {
  const double variance = 2 / (9 * dof);
  return 0.5 * std::erfc((std::cbrt(x / dof) - (1 - variance)) / std::sqrt(2 * variance));
}

}  // namespace

double ChiSquaredTail(double x, double dof) {
  if (!(x > 0)) return 1;
  if (dof > kManyDof || dof != std::round(dof)) return WilsonHilfertyTail(x, dof);
  const double half = x / 2;
  // Terms (x/2)^a e^(−x/2)/Γ(a + 1), a from 0 or ½ in steps of 1, through logarithms: e^(−x/2) alone may vanish.
  const bool even = std::fmod(dof, 2) == 0;
  double sum = even ? 0 : std::erfc(std::sqrt(half));
  for (double a = even ? 0 : 0.5; a <= dof / 2 - 1; ++a) sum += std::exp(a * std::log(half) - half - std::lgamma(a + 1));
  return std::fmin(1, sum);
}

double ChiSquaredQuantile(double tail, double dof) {
  double low = 0, high = dof + 10;
  while (ChiSquaredTail(high, dof) > tail) high *= 2;
  while (high - low > 1e-11 * high) {
    const double middle = (low + high) / 2;
    (ChiSquaredTail(middle, dof) > tail ? low : high) = middle;
  }
  return (low + high) / 2;
}

}  // namespace metaekf::filter
