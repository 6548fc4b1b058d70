#include "core/plot/axis.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>

namespace metaekf::plot {
namespace {

using ::testing::ElementsAre;

std::vector<std::string> Labels(const Axis& axis) {
  std::vector<std::string> labels;
  for (const Tick& tick : axis.ticks) {
    if (!tick.label.empty()) labels.push_back(tick.label);
  }
  return labels;
}

TEST(AxisTest, TicksAreRoundAndInside) {
  // By hand: 10 in about 5 parts gives steps of 2.
  const Axis axis = MakeAxis(0, 10, false, 0, 5);
  EXPECT_THAT(Labels(axis), ElementsAre("0", "2", "4", "6", "8", "10"));
  EXPECT_EQ(axis.ticks[3].value, 6);
  EXPECT_TRUE(axis.factor.empty());
}

TEST(AxisTest, LabelsHaveTheDecimalsOfTheStepAndAMinusSign) {
  EXPECT_THAT(Labels(MakeAxis(-0.5, 0.5, false, 0, 4)),
              ElementsAre("−0.4", "−0.2", "0.0", "0.2", "0.4"));
  EXPECT_THAT(Labels(MakeAxis(0, 0.02, false, 0, 4)),
              ElementsAre("0.000", "0.005", "0.010", "0.015", "0.020"));
}

TEST(AxisTest, SmallAndLargeNumbersShareAFactor) {
  const Axis small = MakeAxis(-6e-4, 6e-4, false, 0, 6);
  EXPECT_EQ(small.factor, "×10⁻⁴");
  EXPECT_THAT(Labels(small), ElementsAre("−6", "−4", "−2", "0", "2", "4", "6"));
  EXPECT_EQ(MakeAxis(0, 1e6, false, 0, 5).factor, "×10⁶");
  EXPECT_EQ(MakeAxis(0, 99999, false, 0, 5).factor, "");
}

TEST(AxisTest, PaddingWidensBothEnds) {
  const Axis axis = MakeAxis(0, 10, false, 0.05, 5);
  EXPECT_DOUBLE_EQ(axis.low, -0.5);
  EXPECT_DOUBLE_EQ(axis.high, 10.5);
  EXPECT_DOUBLE_EQ(axis.Position(-0.5), 0);
  EXPECT_DOUBLE_EQ(axis.Position(5), 0.5);
  EXPECT_DOUBLE_EQ(axis.Position(10.5), 1);
}

TEST(AxisTest, EqualEndsAreMovedApart) {
  for (const double value : {0.0, 3.0, -2e-9, 1e5 + 1e-9}) {
    const Axis axis = MakeAxis(value, value, false, 0.05, 5);
    EXPECT_LT(axis.low, value);
    EXPECT_GT(axis.high, value);
    EXPECT_GE(axis.ticks.size(), 2u) << value;
  }
  const Axis logarithmic = MakeAxis(7, 7, true, 0.05, 5);
  EXPECT_LT(logarithmic.low, 7);
  EXPECT_GT(logarithmic.high, 7);
}

TEST(AxisTest, ALogarithmicAxisMarksPowersOfTen) {
  const Axis axis = MakeAxis(1e-6, 1e-2, true, 0, 5);
  EXPECT_THAT(Labels(axis), ElementsAre("10⁻⁶", "10⁻⁵", "10⁻⁴", "10⁻³", "10⁻²"));
  EXPECT_NEAR(axis.Position(1e-4), 0.5, 1e-12);
  EXPECT_GT(axis.ticks.size(), 30u);  // the minor lines
  EXPECT_THAT(Labels(MakeAxis(1.5, 30, true, 0, 5)), ElementsAre("2·10⁰", "5·10⁰", "10¹", "2·10¹"));
  EXPECT_LE(MakeAxis(1e-30, 1e30, true, 0, 5).ticks.size(), 61u);
  EXPECT_LE(Labels(MakeAxis(1e-30, 1e30, true, 0, 5)).size(), 7u);
}

TEST(AxisTest, TicksAscendAndLieWithinTheAxisForAnyRange) {
  for (double exponent = -20; exponent < 20; exponent += 0.37) {
    for (const double offset : {0.0, 1.0, -0.3}) {
      const double length = std::pow(10.0, exponent);
      for (const bool logarithmic : {false, true}) {
        const double min = logarithmic ? length : offset * length;
        const Axis axis = MakeAxis(min, min + 1.7 * length, logarithmic, 0.05, 5);
        ASSERT_GE(Labels(axis).size(), 1u) << exponent << " " << offset;
        ASSERT_LE(Labels(axis).size(), 10u) << exponent << " " << offset;
        for (size_t i = 0; i < axis.ticks.size(); ++i) {
          EXPECT_GE(axis.Position(axis.ticks[i].value), -1e-9);
          EXPECT_LE(axis.Position(axis.ticks[i].value), 1 + 1e-9);
          if (i > 0) {
            EXPECT_GT(axis.ticks[i].value, axis.ticks[i - 1].value);
          }
        }
      }
    }
  }
}

}  // namespace
}  // namespace metaekf::plot
