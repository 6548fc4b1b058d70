#include "core/filter/chi_squared.h"

#include <gtest/gtest.h>

#include <cmath>

namespace metaekf::filter {
namespace {

TEST(ChiSquaredTest, AgreesWithTheTables) {
  // Quantiles as in every table, at 95 % and 99.9 %.
  EXPECT_NEAR(ChiSquaredQuantile(0.05, 1), 3.841458820694124, 1e-8);
  EXPECT_NEAR(ChiSquaredQuantile(0.05, 2), 5.991464547107979, 1e-8);
  EXPECT_NEAR(ChiSquaredQuantile(0.05, 5), 11.070497693516351, 1e-8);
  EXPECT_NEAR(ChiSquaredQuantile(0.001, 10), 29.58829844507442, 1e-7);
  EXPECT_NEAR(ChiSquaredQuantile(0.95, 30), 18.492660981953467, 1e-7);
  // Two degrees: e^(−x/2).
  EXPECT_NEAR(ChiSquaredTail(40, 2) / std::exp(-20), 1, 1e-12);
  EXPECT_EQ(ChiSquaredTail(0, 3), 1);
}

TEST(ChiSquaredTest, QuantilesUndoTails) {
  for (const double dof : {1.0, 2.0, 7.0, 100.0, 137.5, 900.0}) {
    for (const double tail : {0.999, 0.5, 1e-3, 1e-9}) {
      EXPECT_NEAR(ChiSquaredTail(ChiSquaredQuantile(tail, dof), dof) / tail, 1, 1e-7) << dof << " " << tail;
    }
  }
}

TEST(ChiSquaredTest, TheApproximationMeetsTheExactSum) {
  // 100 degrees exactly against a hair less by Wilson and Hilferty; at 170 the tail is 1.6e-5.
  for (const double x : {70.0, 100.0, 140.0, 170.0}) EXPECT_NEAR(ChiSquaredTail(x, 100) / ChiSquaredTail(x, 100 - 1e-9), 1, 0.05) << x;
}

}  // namespace
}  // namespace metaekf::filter
