#include "core/plot/decimate.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

namespace metaekf::plot {
namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

std::vector<double> Counting(size_t count) {
  std::vector<double> values(count);
  for (size_t i = 0; i < count; ++i) values[i] = static_cast<double>(i);
  return values;
}

TEST(DecimateTest, FewPointsAreKeptAsTheyAre) {
  EXPECT_THAT(Decimate({0, 1, 2, 3}, {5, kNan, 5, 5}, 4), testing::ElementsAre(0u, 1u, 2u, 3u));
  EXPECT_TRUE(Decimate({}, {}, 4).empty());
}

TEST(DecimateTest, KeepsPeaksAndEndsAndStaysBelowTheLimit) {
  std::vector<double> y(100000, 0.0);
  y[31234] = 7;
  y[31235] = -8;
  const std::vector<size_t> kept = Decimate(Counting(y.size()), y, 2000);
  EXPECT_LE(kept.size(), 2000u);
  EXPECT_TRUE(std::is_sorted(kept.begin(), kept.end()));
  for (const size_t index : {size_t{0}, size_t{31234}, size_t{31235}, size_t{99999}}) {
    EXPECT_TRUE(std::binary_search(kept.begin(), kept.end(), index)) << index;
  }
}

TEST(DecimateTest, KeepsTheExtentOfALoop) {
  // A circle: the least and greatest x lie between those of y.
  std::vector<double> x(50000), y(50000);
  for (size_t i = 0; i < x.size(); ++i) {
    x[i] = std::cos(1e-3 * static_cast<double>(i));
    y[i] = std::sin(1e-3 * static_cast<double>(i));
  }
  double least = 1, greatest = -1;
  for (const size_t i : Decimate(x, y, 400)) {
    least = std::min(least, x[i]);
    greatest = std::max(greatest, x[i]);
  }
  EXPECT_EQ(least, *std::min_element(x.begin(), x.end()));
  EXPECT_EQ(greatest, *std::max_element(x.begin(), x.end()));
}

TEST(DecimateTest, LongGapsStayGapsAndSingleOnesDoNot) {
  std::vector<double> y(10000, 1.0);
  for (size_t i = 5000; i < 6000; ++i) y[i] = kNan;
  y[17] = kNan;
  size_t gaps = 0;
  for (const size_t i : Decimate(Counting(y.size()), y, 400)) {
    if (std::isnan(y[i])) {
      ++gaps;
      EXPECT_GE(i, 5000u);
      EXPECT_LT(i, 6000u);
    }
  }
  // 1000 of 10000 samples are 10 of the 100 stretches.
  EXPECT_EQ(gaps, 10u);
}

}  // namespace
}  // namespace metaekf::plot
