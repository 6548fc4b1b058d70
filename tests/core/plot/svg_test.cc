#include "core/plot/svg.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <limits>
#include <sstream>

namespace metaekf::plot {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

size_t Count(const std::string& text, const std::string& part) {
  size_t count = 0;
  for (size_t at = text.find(part); at != std::string::npos; at = text.find(part, at + 1)) ++count;
  return count;
}

/// Every element closed in order, and nothing that is not a number where one belongs.
void ExpectWellFormed(const std::string& svg) {
  std::vector<std::string> open;
  for (size_t at = svg.find('<'); at != std::string::npos; at = svg.find('<', at + 1)) {
    const size_t end = svg.find('>', at);
    ASSERT_NE(end, std::string::npos);
    const std::string tag = svg.substr(at + 1, end - at - 1);
    ASSERT_EQ(tag.find('<'), std::string::npos) << tag;
    ASSERT_EQ(Count(tag, "\"") % 2, 0u) << tag;
    const std::string name = tag.substr(0, tag.find_first_of(" /", 1));
    if (tag.starts_with('/')) {
      ASSERT_FALSE(open.empty());
      EXPECT_EQ("/" + open.back(), tag);
      open.pop_back();
    } else if (!tag.ends_with('/')) {
      open.push_back(name);
    }
  }
  EXPECT_TRUE(open.empty());
  EXPECT_THAT(svg, Not(HasSubstr("nan")));
  EXPECT_THAT(svg, Not(HasSubstr("inf")));
}

Figure OnePanel(Series series, bool logarithmic = false) {
  return {.panels = {{.logarithmic_y = logarithmic, .series = {std::move(series)}}}};
}

std::string Rendered(const Figure& figure) {
  const auto svg = RenderSvg(figure);
  EXPECT_TRUE(svg.ok()) << svg.status();
  ExpectWellFormed(*svg);
  return *svg;
}

TEST(SvgTest, DrawsALineFromCornerToCorner) {
  Figure figure = OnePanel({"", {0, 10}, {0, 1}});
  figure.width_px = 296;
  figure.panel_height_px = 110;
  // By hand: margins 78 and 18 leave 200 px; the plot begins at 8 + 6; 5 % padding of 110 px is 5
  // at each end.
  EXPECT_THAT(Rendered(figure), HasSubstr("d=\"M78 119L278 19\""));
}

TEST(SvgTest, NamesEverything) {
  Figure figure{.title = "T", .x_label = "time (s)"};
  figure.panels = {{.title = "A",
                    .y_label = "y (mm)",
                    .bands = {{"±2σ", {0, 1}, {0, 0}, {1, 1}}},
                    .series = {{"truth", {0, 1}, {0, 1}}, {"", {0, 1}, {1, 0}}}},
                   {.title = "B"}};
  const std::string svg = Rendered(figure);
  for (const char* text : {">T<", ">time (s)<", ">A<", ">B<", ">y (mm)<", ">±2σ<", ">truth<"}) {
    EXPECT_EQ(Count(svg, text), 1u) << text;
  }
}

TEST(SvgTest, EscapesTexts) {
  Figure figure = OnePanel({"a<b & \"c\"\x01", {0, 1}, {0, 1}});
  EXPECT_THAT(Rendered(figure), HasSubstr(">a&lt;b &amp; &quot;c&quot; <"));
}

TEST(SvgTest, MissingValuesAreGapsAndLonelyOnesDots) {
  const std::string svg = Rendered(OnePanel({"", {0, 1, 2, 3, 4, 5}, {0, 1, kNan, 1, kNan, 0}}));
  const size_t begin = svg.find("<path d=\"M", svg.find("clip-path"));
  const std::string path = svg.substr(begin, svg.find("/>", begin) - begin);
  EXPECT_EQ(Count(path, "M"), 3u);
  EXPECT_EQ(Count(path, "L"), 1u);
  EXPECT_EQ(Count(path, "h0"), 2u);
}

TEST(SvgTest, ALogarithmicAxisLeavesOutWhatHasNoLogarithm) {
  const std::string svg =
      Rendered(OnePanel({"", {0, 1, 2, 3}, {1, 0, -5, 100}, Mark::kPoints}, true));
  EXPECT_EQ(Count(svg, "<circle"), 2u);
  EXPECT_THAT(svg, HasSubstr(">10²<"));
}

TEST(SvgTest, AMillionPointsMakeASmallFile) {
  Series series;
  Band band;
  for (int i = 0; i < 1000000; ++i) {
    series.x.push_back(i);
    series.y.push_back(std::sin(0.1 * i));
    band.lower.push_back(-2);
    band.upper.push_back(2);
  }
  band.x = series.x;
  Figure figure = OnePanel(series);
  figure.panels[0].bands = {band};
  EXPECT_LT(Rendered(figure).size(), 60000u);
}

TEST(SvgTest, AWideBandDoesNotFlattenTheCurve) {
  Figure figure = OnePanel({"", {0, 1}, {0, 1}});
  figure.panels[0].bands = {{"", {0, 1}, {-1e6, -0.1}, {1e6, 1.1}}};
  const std::string svg = Rendered(figure);
  // The axis reaches half a range beyond the curve, −0.5 to 1.5 and padding: no millions on it.
  EXPECT_THAT(svg, HasSubstr(">1.5<"));
  EXPECT_THAT(svg, HasSubstr(">−0.5<"));
  EXPECT_THAT(svg, Not(HasSubstr("×10")));
}

TEST(SvgTest, ALegendThatDoesNotFitGoesOnBelow) {
  Figure figure = OnePanel({std::string(100, 'a'), {0, 1}, {0, 1}});
  const double one_row = Count(Rendered(figure), "\n");
  figure.panels[0].series.push_back({std::string(100, 'b'), {0, 1}, {0, 1}});
  const std::string svg = Rendered(figure);
  EXPECT_GT(Count(svg, "\n"), one_row);
  // Both entries begin at the left margin.
  EXPECT_EQ(Count(svg, "<path class=\"curve\" d=\"M78 "), 2u);
}

TEST(SvgTest, AutomaticColoursDifferAndChosenOnesAreKept) {
  Figure figure = OnePanel({"", {0, 1}, {0, 1}});
  figure.panels[0].series.push_back({"", {0, 1}, {1, 0}});
  figure.panels[0].series.push_back({"", {0, 1}, {1, 1}, Mark::kDashes, Colour::kBlack});
  const std::string svg = Rendered(figure);
  EXPECT_EQ(Count(svg, "stroke=\"#0072b2\""), 1u);
  EXPECT_EQ(Count(svg, "stroke=\"#d55e00\""), 1u);
  EXPECT_EQ(Count(svg, "stroke=\"#222222\" class=\"curve\" stroke-dasharray"), 1u);
}

TEST(SvgTest, EmptyConstantAndExtremeDataStillMakeAPicture) {
  Rendered({.panels = {{}}});
  Rendered(OnePanel({"", {}, {}}, true));
  Rendered(OnePanel({"", {1}, {5}}));
  Rendered(OnePanel({"", {1, 1}, {kNan, kNan}}));
  Rendered(OnePanel({"", {0, 1, 2}, {-1e308, 1e308, HUGE_VAL}}));
  Rendered(OnePanel({"", {0, 1}, {5e-324, 1e-310}}, true));
  Figure bands = OnePanel({"", {}, {}}, true);
  bands.panels[0].bands = {{"", {0, kNan, 2}, {-1, 1, kNan}, {1, 2, 3}}};
  Rendered(bands);
}

TEST(SvgTest, RefusesFiguresThatCannotBeDrawn) {
  EXPECT_EQ(RenderSvg({}).status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(RenderSvg(OnePanel({"", {0, 1}, {0}})).status().code(),
            absl::StatusCode::kInvalidArgument);
  Figure figure = OnePanel({"", {0, 1}, {0, 1}});
  figure.panels[0].bands = {{"", {0, 1}, {0, 1}, {0}}};
  EXPECT_EQ(RenderSvg(figure).status().code(), absl::StatusCode::kInvalidArgument);
}

TEST(SvgTest, WritesTheSameToAFile) {
  const Figure figure = OnePanel({"", {0, 1}, {0, 1}});
  const std::string path = testing::TempDir() + "/figure.svg";
  ASSERT_TRUE(WriteSvgFile(figure, path).ok());
  std::ostringstream text;
  text << std::ifstream(path).rdbuf();
  EXPECT_EQ(text.str(), Rendered(figure));
  std::filesystem::remove(path);
  EXPECT_EQ(WriteSvgFile(figure, "/nowhere/figure.svg").code(), absl::StatusCode::kNotFound);
  if (std::filesystem::exists("/dev/full")) {
    EXPECT_EQ(WriteSvgFile(figure, "/dev/full").code(), absl::StatusCode::kDataLoss);
  }
}

TEST(SvgTest, ALogarithmicXAxisPutsPowersOfTenAtEvenDistances) {
  Figure figure = OnePanel({.x = {1, 10, 100}, .y = {0, 1, 2}});
  figure.logarithmic_x = true;
  const std::string svg = Rendered(figure);
  EXPECT_THAT(svg, HasSubstr(">10¹</text>"));
  // On both axes even: a straight line, its middle point half way. Plot area: 78 … 882, 2 % of 2 decades beside it.
  const std::string linear = Rendered(OnePanel({.x = {0, 1, 2}, .y = {0, 1, 2}}));
  EXPECT_THAT(svg, HasSubstr("L480 "));
  EXPECT_THAT(linear, HasSubstr("L480 "));
}

}  // namespace
}  // namespace metaekf::plot
