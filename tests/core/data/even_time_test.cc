#include "core/data/even_time.h"

#include <gtest/gtest.h>

#include <cstdio>
#include <string>
#include <vector>

#include "core/base/numbers.h"

namespace metaekf::data {
namespace {

/// Index of the first time that is refused, or −1; `period_s` is what the times before it give.
int FirstRefused(const std::vector<std::string>& times, double* period_s = nullptr) {
  EvenTime time;
  int refused = -1;
  for (size_t k = 0; k < times.size() && refused < 0; ++k) {
    if (!time.Add(times[k], *base::ParseDouble(times[k])).ok()) refused = static_cast<int>(k);
  }
  if (period_s != nullptr) *period_s = time.PeriodS();
  return refused;
}

/// start + k · period, printed by `format`, or exactly where it is empty.
std::vector<std::string> Printed(double start_s, double period_s, int count,
                                 const std::string& format) {
  std::vector<std::string> times;
  for (int k = 0; k < count; ++k) {
    const double time_s = start_s + k * period_s;
    char text[64];
    std::snprintf(text, sizeof(text), format.c_str(), time_s);
    times.push_back(format.empty() ? base::FormatExact(time_s) : text);
  }
  return times;
}

TEST(EvenTimeTest, HalfLastDigitFollowsTheText) {
  // By hand.
  EXPECT_DOUBLE_EQ(HalfLastDigit("1.25"), 0.005);
  EXPECT_DOUBLE_EQ(HalfLastDigit("10"), 0.5);
  EXPECT_DOUBLE_EQ(HalfLastDigit("1.2e3"), 50);
  EXPECT_DOUBLE_EQ(HalfLastDigit("-3e-05"), 5e-6);
  EXPECT_DOUBLE_EQ(HalfLastDigit("4."), 0.5);
}

TEST(EvenTimeTest, AcceptsEveryCommonWayToPrintEvenTimes) {
  for (const double period_s : {1.0 / 750, 0.01, 0.1, 1.0, 2.5, 1.0 / 3}) {
    for (const double start_s : {0.0, 0.3, 5.0, 1.7e9}) {
      for (const std::string format : {"", "%.9f", "%.17g"}) {
        const auto times = Printed(start_s, period_s, 3000, format);
        double found_s = 0;
        EXPECT_EQ(FirstRefused(times, &found_s), -1) << period_s << " " << start_s << " " << format;
        EXPECT_NEAR(found_s, period_s, 1e-9 * period_s + 1e-9) << start_s << " " << format;
      }
    }
  }
}

TEST(EvenTimeTest, AcceptsTimesRoundedToFewDigits) {
  // 750 Hz: 0, 0.0013, 0.0027, … and even 0, 0.001, 0.003, …; the rate is found all the same.
  for (const char* format : {"%.3f", "%.4f", "%.5f", "%.6f"}) {
    for (const int skipped : {0, 1, 17}) {
      // With a start that is rounded to whole milliseconds too, 750 Hz and a lost sample look the
      // same.
      if (skipped == 17 && format == std::string("%.3f")) continue;
      const auto times = Printed(skipped / 750.0, 1.0 / 750, 2000, format);
      double found_s = 0;
      EXPECT_EQ(FirstRefused(times, &found_s), -1) << format << " " << skipped;
      EXPECT_EQ(found_s, 1.0 / 750) << format << " " << skipped;
    }
  }
  // Six significant digits, as streams of C++ print: fine steps first, coarse ones later.
  EXPECT_EQ(FirstRefused(Printed(0, 1.0 / 750, 9000, "%g")), -1);
}

TEST(EvenTimeTest, ThePeriodThatWasPrintedIsFoundExactly) {
  for (const double period_s : {1.0 / 750, 0.01, 0.0123, 1.0 / 3, 0.7}) {
    double found_s = 0;
    EXPECT_EQ(FirstRefused(Printed(0, period_s, 5000, ""), &found_s), -1);
    EXPECT_EQ(found_s, period_s);
  }
  double found_s = 0;
  EXPECT_EQ(FirstRefused(Printed(0.3, 0.01, 500, ""), &found_s), -1);
  EXPECT_EQ(found_s, 0.01);
}

TEST(EvenTimeTest, NamesTheFirstRowAfterALostSample) {
  for (const double start_s : {0.0, 5.0, 0.3}) {
    for (const size_t lost : {3u, 50u, 400u}) {
      for (const std::string format : {"", "%.2f", "%.5f"}) {
        auto times = Printed(start_s, 0.01, 500, format);
        times.erase(times.begin() + lost);
        EXPECT_EQ(FirstRefused(times), static_cast<int>(lost)) << start_s << " " << format;
      }
    }
  }
}

TEST(EvenTimeTest, ToleratesHalfTheLastDigitAndNoMore) {
  // By hand: steps of 0.1 s; the last is late by 0.04 s where that is below half its last digit,
  // and where it is not; then by less and by more than half a millisecond.
  EXPECT_EQ(FirstRefused({"0.00", "0.10", "0.20", "0.3"}), -1);
  EXPECT_EQ(FirstRefused({"0.00", "0.10", "0.20", "0.34"}), 3);
  EXPECT_EQ(FirstRefused({"0", "0.33", "0.67", "1.00"}), -1);
  EXPECT_EQ(FirstRefused({"0", "0.33", "0.68", "1.00"}), 2);
  EXPECT_EQ(FirstRefused({"5", "5.010", "5.024", "5.030"}), 2);
}

TEST(EvenTimeTest, RefusesTimeThatStandsStillOrGoesBack) {
  EXPECT_EQ(FirstRefused({"0", "1", "1"}), 2);
  EXPECT_EQ(FirstRefused({"0", "1", "0.5"}), 2);
  EXPECT_EQ(FirstRefused({"1", "0"}), 1);
}

TEST(EvenTimeTest, OneTimeHasNoPeriod) {
  double period_s = -1;
  EXPECT_EQ(FirstRefused({"3"}, &period_s), -1);
  EXPECT_EQ(period_s, 0);
}

}  // namespace
}  // namespace metaekf::data
