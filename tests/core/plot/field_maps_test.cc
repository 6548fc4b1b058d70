#include "core/plot/field_maps.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <limits>
#include <regex>

namespace metaekf::plot {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

FieldMaps Example() {
  FieldMaps maps{.title = "Error", .x_label = "x (m)", .y_label = "y (m)", .value_label = "A/m"};
  maps.maps = {{"one", Eigen::Matrix2d{{0, 0}, {1, std::numeric_limits<double>::quiet_NaN()}}}};
  return maps;
}

int CountOf(const std::string& svg, const std::string& text) {
  int count = 0;
  for (size_t at = svg.find(text); at != std::string::npos; at = svg.find(text, at + 1)) ++count;
  return count;
}

TEST(FieldMapsTest, CellsOfOneColourInARowAreOneRectangle) {
  const auto svg = RenderSvg(Example());
  ASSERT_TRUE(svg.ok()) << svg.status();
  // The lower row is one rectangle of the lightest colour, the upper one a cell of the darkest; the bar shows each once.
  EXPECT_EQ(CountOf(*svg, "#fff6cc"), 2);
  EXPECT_EQ(CountOf(*svg, "#3a0f5c"), 2);
  EXPECT_THAT(*svg, HasSubstr("width=\"300\" height=\"150\" fill=\"#fff6cc\""));
  EXPECT_THAT(*svg, HasSubstr("width=\"150\" height=\"150\" fill=\"#3a0f5c\""));
  EXPECT_THAT(*svg, Not(HasSubstr("nan")));
}

TEST(FieldMapsTest, YGoesUpwards) {
  const auto svg = RenderSvg(Example());
  ASSERT_TRUE(svg.ok()) << svg.status();
  const auto top_of = [&svg](const std::string& colour) {
    std::smatch match;
    const std::regex cell("y=\"([0-9.]+)\" width=\"(?:300|150)\" height=\"150\" fill=\"" + colour);
    return std::regex_search(*svg, match, cell) ? std::stod(match[1]) : -1;
  };
  EXPECT_EQ(top_of("#fff6cc") - top_of("#3a0f5c"), 150);
}

TEST(FieldMapsTest, MapsShareTheScaleWhoseEndsMayBeGiven) {
  FieldMaps maps = Example();
  maps.maps.push_back({"ten times", 10 * maps.maps[0].values});
  const auto shared = RenderSvg(maps);
  ASSERT_TRUE(shared.ok());
  EXPECT_EQ(CountOf(*shared, "#3a0f5c"), 2) << "the cell of the second map and the bar";
  maps.low = 0;
  maps.high = 1;
  const auto given = RenderSvg(maps);
  ASSERT_TRUE(given.ok());
  EXPECT_EQ(CountOf(*given, "#3a0f5c"), 3) << "what lies beyond has the end's colour";
}

TEST(FieldMapsTest, WhatCannotBeDrawnIsRefused) {
  EXPECT_FALSE(RenderSvg(FieldMaps()).ok());
  FieldMaps maps = Example();
  maps.maps.push_back({"empty", {}});
  EXPECT_THAT(RenderSvg(maps).status().message(), HasSubstr("empty"));
}

}  // namespace
}  // namespace metaekf::plot
