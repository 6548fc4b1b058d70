#include "client/cli/figures.h"

#include <gtest/gtest.h>

#include <cmath>

namespace metaekf::cli {
namespace {

const double kNaN = std::nan("");

TEST(FiguresTest, ErrorsArePooledOverTrajectories) {
  data::Trajectory a, b;
  a.outputs = Eigen::RowVector3d(9, 1, 2);
  b.outputs = Eigen::RowVector2d(9, 6);
  Predicted to_a{.outputs = Eigen::RowVector3d(kNaN, 2, 2), .warmup = 1};
  Predicted to_b{.outputs = Eigen::RowVector2d(kNaN, 4), .warmup = 1};
  const ErrorFigures figures = Score({a, b}, {to_a, to_b});
  // Errors −1, 0, 2 at y = 1, 2, 6, of mean 3: Σe² = 5, Σ(y − ȳ)² = 4 + 1 + 9 = 14.
  EXPECT_EQ(figures.samples, 3);
  EXPECT_DOUBLE_EQ(figures.rmse[0], std::sqrt(5.0 / 3));
  EXPECT_DOUBLE_EQ(figures.fit_percent[0], 100 * (1 - std::sqrt(5.0 / 14)));
}

TEST(FiguresTest, WhatWasNotMeasuredOrComesBeforeTheStartDoesNotCount) {
  data::Trajectory a;
  a.outputs = Eigen::RowVector4d(0, 1, kNaN, 3);
  Predicted to_a{.outputs = Eigen::RowVector4d(50, 60, 7, 1)};
  const ErrorFigures figures = Score({a}, {to_a}, 2);
  EXPECT_EQ(figures.samples, 2);  // both are predicted, one of them was measured
  EXPECT_DOUBLE_EQ(figures.rmse[0], 2);
  EXPECT_TRUE(std::isnan(figures.fit_percent[0]));  // one value does not vary
}

TEST(FiguresTest, WithoutAnyPredictionThereIsNoFigure) {
  data::Trajectory a;
  a.outputs = Eigen::RowVector2d(1, 2);
  const ErrorFigures figures = Score({a}, {{.outputs = Eigen::RowVector2d(kNaN, kNaN)}});
  EXPECT_EQ(figures.samples, 0);
  EXPECT_TRUE(std::isnan(figures.rmse[0]));
}

}  // namespace
}  // namespace metaekf::cli
