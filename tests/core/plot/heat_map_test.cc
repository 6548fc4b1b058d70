#include "core/plot/heat_map.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <limits>

namespace metaekf::plot {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

HeatMap Example() {
  HeatMap map{.title = "Errors < 1", .x_label = "share", .columns = {"10 %", "20 %"}, .rows = {"a", "b"}};
  map.values = (Eigen::MatrixXd(2, 2) << 1, 10, 100, std::numeric_limits<double>::quiet_NaN()).finished();
  return map;
}

TEST(HeatMapTest, WritesEveryValueAndLeavesWhatIsNoNumberBlank) {
  const auto svg = RenderSvg(Example());
  ASSERT_TRUE(svg.ok()) << svg.status();
  for (const char* text : {">1</text>", ">10</text>", ">100</text>", ">10 %</text>", ">b</text>", "Errors &lt; 1"}) {
    EXPECT_THAT(*svg, HasSubstr(text));
  }
  EXPECT_THAT(*svg, Not(HasSubstr("nan")));
}

TEST(HeatMapTest, TheLeastIsLightestAndTheGreatestDarkest) {
  // The ends of the colour scale; in the middle of a logarithmic scale of 1 … 100 stands 10, half way between the two stops
  // (245, 173, 92) and (196, 66, 94): (220.5, 119.5, 93).
  HeatMap map = Example();
  map.logarithmic = true;
  const auto svg = RenderSvg(map);
  ASSERT_TRUE(svg.ok()) << svg.status();
  for (const char* colour : {"#fff6cc", "#3a0f5c", "#dd785d"}) EXPECT_THAT(*svg, HasSubstr(colour));
}

TEST(HeatMapTest, TheFirstRowsMaySpanTheScale) {
  HeatMap map{.columns = {"1", "2"}, .rows = {"a", "b"}, .values = Eigen::Matrix2d{{1, 2}, {1000, 0}}, .scale_rows = 1};
  const auto svg = RenderSvg(map);
  ASSERT_TRUE(svg.ok()) << svg.status();
  const auto count = [&](const std::string& colour) {
    size_t found = 0;
    for (size_t at = svg->find(colour); at != std::string::npos; at = svg->find(colour, at + 1)) ++found;
    return found;
  };
  EXPECT_EQ(count("#fff6cc"), 2U);  // 1 and what is below it
  EXPECT_EQ(count("#3a0f5c"), 2U);  // 2 and what is above it
}

TEST(HeatMapTest, ValuesThatAreAllTheSameAreNoError) {
  HeatMap map{.columns = {"1"}, .rows = {"a"}, .values = Eigen::MatrixXd::Constant(1, 1, 3)};
  EXPECT_TRUE(RenderSvg(map).ok());
}

TEST(HeatMapTest, NamesAndValuesMustAgree) {
  HeatMap map = Example();
  map.rows.pop_back();
  EXPECT_EQ(RenderSvg(map).status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(RenderSvg(HeatMap()).status().code(), absl::StatusCode::kInvalidArgument);
}

}  // namespace
}  // namespace metaekf::plot
