#include "core/base/numbers.h"

#include <gtest/gtest.h>

#include <bit>
#include <cmath>

#include "core/base/rng.h"

namespace metaekf::base {
namespace {

TEST(NumbersTest, EveryFiniteDoubleReadsBackExactly) {
  Rng rng(3);
  for (int i = 0; i < 20000; ++i) {
    const double value = std::bit_cast<double>(rng.NextBits());
    if (!std::isfinite(value)) continue;
    const auto back = ParseDouble(FormatExact(value));
    ASSERT_TRUE(back.has_value()) << FormatExact(value);
    EXPECT_EQ(*back, value);
  }
}

TEST(NumbersTest, ReadsWhatPeopleWrite) {
  EXPECT_EQ(ParseDouble(" +1.5e-3\r"), 1.5e-3);
  EXPECT_EQ(ParseDouble("-2"), -2.0);
  EXPECT_TRUE(std::isnan(*ParseDouble("NaN")));
  EXPECT_EQ(ParseDouble("1e-400"), 0.0);
  EXPECT_EQ(ParseDouble("-1e400"), -HUGE_VAL);
}

TEST(NumbersTest, RefusesWhatIsNotANumber) {
  for (const char* text : {"", " ", "1,5", "abc", "1.0x", "--1", "+-1", "0x10"}) {
    EXPECT_FALSE(ParseDouble(text).has_value()) << text;
  }
}

}  // namespace
}  // namespace metaekf::base
