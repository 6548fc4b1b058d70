#include "core/plot/box_plot.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <limits>

namespace metaekf::plot {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

TEST(BoxPlotTest, TheBoxEndsAtTheQuartiles) {
  // 0 … 100: quartiles 25 and 75, whiskers 0.5 and 99.5. The axis is 1.06 times 99 long, padding 3 % on either side; drawn over 560 px.
  Box box{.label = "a < b"};
  for (int i = 100; i >= 0; --i) box.values.push_back(i);
  const auto svg = RenderSvg(BoxPlot{.title = "Errors", .x_label = "mm", .boxes = {box}});
  ASSERT_TRUE(svg.ok()) << svg.status();
  EXPECT_THAT(*svg, HasSubstr(">a &lt; b</text>"));
  const double px_per_unit = 560 / (1.06 * 99);
  char width[32];
  std::snprintf(width, sizeof(width), "width=\"%.1f\"", 50 * px_per_unit);
  EXPECT_THAT(*svg, HasSubstr(width));
}

TEST(BoxPlotTest, WhatTheAxisCannotShowDoesNotCount) {
  const double infinite = std::numeric_limits<double>::infinity();
  const auto svg = RenderSvg(BoxPlot{.logarithmic = true, .boxes = {{.label = "a", .values = {1, 10, infinite, -1, 0}}, {.label = "b"}}});
  ASSERT_TRUE(svg.ok()) << svg.status();
  EXPECT_THAT(*svg, HasSubstr(">b</text>"));
  EXPECT_THAT(*svg, Not(HasSubstr("nan")));
  EXPECT_THAT(*svg, Not(HasSubstr("inf")));
}

TEST(BoxPlotTest, NeedsABox) { EXPECT_EQ(RenderSvg(BoxPlot()).status().code(), absl::StatusCode::kInvalidArgument); }

}  // namespace
}  // namespace metaekf::plot
