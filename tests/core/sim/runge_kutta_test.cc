#include "core/sim/runge_kutta.h"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <cmath>
#include <limits>

namespace metaekf::sim {
namespace {

double Distance(double a, double b) { return std::abs(a - b); }

TEST(RungeKuttaTest, OneStepOfExponentialGrowthIsTheTaylorPolynomial) {
  // On ẋ = x the method of order 4 is 1 + h + h²/2 + h³/6 + h⁴/24.
  const auto field = [](double, double x) { return x; };
  const double h = 0.3;
  EXPECT_DOUBLE_EQ(RungeKuttaStep(field, 0.0, 1.0, h),
                   1 + h + h * h / 2 + h * h * h / 6 + h * h * h * h / 24);
}

TEST(RungeKuttaTest, HasOrderFourInTimeAndState) {
  // ẋ₁ = x₂, ẋ₂ = −x₁ + t: x₁ = t + cos t. Halving the step must divide the error by about 16.
  const auto field = [](double t, const Eigen::Vector2d& x) {
    return Eigen::Vector2d(x[1], t - x[0]);
  };
  const auto error = [&field](int steps) {
    Eigen::Vector2d x(1, 1);
    const double h = 2.0 / steps;
    for (int i = 0; i < steps; ++i) x = RungeKuttaStep(field, i * h, x, h);
    return std::abs(x[0] - (2 + std::cos(2.0)));
  };
  EXPECT_NEAR(error(20) / error(40), 16, 1);
}

TEST(RungeKuttaTest, RefiningFindsAKinkInsideAStep) {
  // ẋ = |t − 0.3| over [0, 1]: x = (0.3² + 0.7²) / 2.
  const auto field = [](double t, double) { return std::abs(t - 0.3); };
  const double full = RungeKuttaStep(field, 0.0, 0.0, 1.0);
  EXPECT_GT(std::abs(full - 0.29), 1e-3);
  const double refined = RefineStep(field, 0.0, 0.0, 1.0, full, Distance, 1e-12, 40);
  EXPECT_NEAR(refined, 0.29, 1e-12);
}

TEST(RungeKuttaTest, SplitsNoMoreThanItMay) {
  int calls = 0;
  const auto field = [&calls](double, double x) {
    ++calls;
    return x;
  };
  const auto never = [](double, double) { return std::numeric_limits<double>::quiet_NaN(); };
  RefineStep(field, 0.0, 1.0, 1.0, 0.0, never, 1e-3, 0);
  EXPECT_EQ(calls, 8);  // two steps of four evaluations
  calls = 0;
  RefineStep(field, 0.0, 1.0, 1.0, 0.0, never, 1e-3, 2);
  // By hand: 2 steps here; for each half 2 more, for each quarter 2 more, and the second half and
  // the two second quarters once again: 2 + 4 + 8 + 3 steps.
  EXPECT_EQ(calls, 4 * 17);
}

}  // namespace
}  // namespace metaekf::sim
