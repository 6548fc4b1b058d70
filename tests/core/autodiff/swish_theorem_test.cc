#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <utility>

#include "core/autodiff/activation.h"

namespace metaekf::autodiff {
namespace {

/// Σ c z^i e^{jz} as (i, j) → c.
using Numerator = std::map<std::pair<int, int>, double>;

/// The theorem on swish (paper.tex thm:2): ς^(n)(z) = N_n(z, e^z)/(1 + e^z)^{n+1}. Its induction step is
/// N_{n+1} = (1 + e^z) N_n' − (n + 1) e^z N_n, with (z^i e^{jz})' = i z^{i−1} e^{jz} + j z^i e^{jz}.
Numerator Next(const Numerator& numerator, int n) {
  Numerator next;
  for (const auto& [power, c] : numerator) {
    const auto [i, j] = power;
    for (const int shift : {0, 1}) {
      if (i > 0) next[{i - 1, j + shift}] += i * c;
      next[{i, j + shift}] += j * c;
    }
    next[{i, j + 1}] -= (n + 1) * c;
  }
  std::erase_if(next, [](const auto& term) { return term.second == 0; });
  return next;
}

double Evaluate(const Numerator& numerator, int n, double z) {
  double sum = 0;
  for (const auto& [power, c] : numerator) sum += c * std::pow(z, power.first) * std::exp(power.second * z);
  return sum / std::pow(1 + std::exp(z), n + 1);
}

// z/(1 + e^{−z}) = z e^z/(1 + e^z).
const Numerator kSwish = {{{1, 1}, 1}};

TEST(SwishTheoremTest, TheFirstDerivativeIsThePapers) {
  EXPECT_EQ(Next(kSwish, 0), (Numerator{{{1, 1}, 1}, {{0, 1}, 1}, {{0, 2}, 1}}));  // (z + 1) e^z + e^{2z}
}

TEST(SwishTheoremTest, DerivativesAreTheQuotientsOfTheTheorem) {
  Numerator numerator = kSwish;
  for (int order = 0; order <= kMaxDerivative; ++order) {
    if (order > 0) numerator = Next(numerator, order - 1);
    for (double z = -12; z <= 12; z += 0.37) {
      double value = 0;
      ApplyActivation<double>(Activation::kSwish, order, 0, &z, &value, 1);
      EXPECT_NEAR(value, Evaluate(numerator, order, z), 1e-12 * (1 + std::abs(z))) << order << " at " << z;
    }
  }
}

// Beyond the orders that are computed: each quotient is the derivative of the one before, and all stay bounded: no saturation of the
// derivatives that a curl-free field and its Jacobian are made of, and none that explodes.
TEST(SwishTheoremTest, TheInductionGoesOn) {
  Numerator numerator = Next(kSwish, 0);
  for (int order = 1; order < 8; ++order) {
    const Numerator next = Next(numerator, order);
    for (double z = -6; z <= 6; z += 0.29) {
      constexpr double kStep = 1e-4;
      const double difference = (Evaluate(numerator, order, z + kStep) - Evaluate(numerator, order, z - kStep)) / (2 * kStep);
      EXPECT_NEAR(Evaluate(next, order + 1, z), difference, 1e-5 * (1 + std::pow(3.0, order)));
      EXPECT_LT(std::abs(Evaluate(next, order + 1, z)), std::tgamma(order + 2));
    }
    for (const auto& [power, c] : next) {
      EXPECT_LE(power.first, 1);          // z enters at most once
      EXPECT_LE(power.second, order + 2);  // e^z at most as often as below
      EXPECT_EQ(c, std::round(c));
    }
    numerator = next;
  }
}

}  // namespace
}  // namespace metaekf::autodiff
