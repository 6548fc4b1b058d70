#include "core/sim/signal.h"

#include <gtest/gtest.h>

#include <cmath>
#include <complex>
#include <numbers>

#include "core/sim/fourier.h"

namespace metaekf::sim {
namespace {

constexpr double kPi = std::numbers::pi;

TEST(SignalTest, AMultisineHasTheRmsAndOnlyTheLinesAskedFor) {
  // 5 to 150 Hz at 750 Hz and 8192 samples: lines 55 to 1638, 8192 · 5 / 750 = 54.6 and 8192 / 5 =
  // 1638.4.
  base::Rng rng(1);
  const auto multisine = DrawMultisine(5.0 / 750, 150.0 / 750, 50, 8192, rng);
  ASSERT_TRUE(multisine.ok()) << multisine.status();
  ASSERT_EQ(multisine->size(), 8192u);
  double sum_of_squares = 0;
  for (const double value : *multisine) sum_of_squares += value * value;
  EXPECT_NEAR(std::sqrt(sum_of_squares / 8192), 50, 1e-10);
  const auto spectrum = RealFourier(8192).Forward(*multisine);
  // Each line has amplitude 50 √(2/1584), so |X_k| is that times 8192 / 2.
  const double line = 50 * std::sqrt(2.0 / 1584) * 4096;
  for (size_t k = 0; k < spectrum.size(); ++k) {
    EXPECT_NEAR(std::abs(spectrum[k]), k >= 55 && k <= 1638 ? line : 0, 1e-8) << k;
  }
}

TEST(SignalTest, PhasesFollowTheGenerator) {
  base::Rng same_a(1), same_b(1), other(2);
  const auto a = DrawMultisine(0.01, 0.2, 1, 256, same_a);
  EXPECT_EQ(*a, *DrawMultisine(0.01, 0.2, 1, 256, same_b));
  EXPECT_NE(*a, *DrawMultisine(0.01, 0.2, 1, 256, other));
}

TEST(SignalTest, ALineOnTheEdgeOfTheBandBelongsToIt) {
  // By hand: of 1000 samples, 0.007 and 0.009 are lines 7 and 9, though 0.007 · 1000 rounds
  // above 7.
  base::Rng rng(1);
  const auto spectrum = RealFourier(1000).Forward(*DrawMultisine(0.007, 0.009, 1, 1000, rng));
  for (size_t k = 0; k < 20; ++k) {
    EXPECT_EQ(std::abs(spectrum[k]) > 1, k >= 7 && k <= 9) << k;
  }
}

TEST(SignalTest, RefusesABandWithoutLines) {
  base::Rng rng(1);
  for (const auto& [low, high] : {std::pair{0.0, 0.2}, {0.1, 0.5}, {0.2, 0.1}, {0.101, 0.102}}) {
    EXPECT_EQ(DrawMultisine(low, high, 1, 100, rng).status().code(),
              absl::StatusCode::kInvalidArgument)
        << low;
  }
}

TEST(SignalTest, ABandLimitedSignalIsTheMultisineBetweenSamplesToo) {
  // Lines up to 0.2 cycles per sample, evaluated directly at times off every grid. Interpolating on
  // a grid of h = 1/16 sample errs by up to 3.63 (2π f h)⁵ / 5! = 9e-8 of the highest line.
  const double frequencies[] = {7.0 / 400, 41.0 / 400, 80.0 / 400};
  const auto value = [&frequencies](double time) {
    double sum = 0;
    for (const double f : frequencies) sum += std::cos(2 * kPi * f * time + 10 * f);
    return sum;
  };
  std::vector<double> record(400);
  for (size_t t = 0; t < 400; ++t) record[t] = value(static_cast<double>(t));
  const Signal signal = Signal::FromRecord(record, Hold::kBandLimited, 4);
  for (Eigen::Index t : {0, 17, 399, 401}) {
    for (int segment = 0; segment < 4; ++segment) {
      for (const double part : {0.0, 0.1, 0.37, 0.9, 1.0}) {
        const double time = static_cast<double>(t) + (segment + part) / 4;
        EXPECT_NEAR(signal.Segment(t, segment)(part), value(time), 1e-7) << t << " " << time;
      }
    }
  }
}

TEST(SignalTest, LinearAndZeroHoldsAreWhatTheySay) {
  // By hand, with the record beginning again after its last sample.
  const std::vector<double> record = {0, 4, -2};
  const Signal linear = Signal::FromRecord(record, Hold::kLinear, 2);
  EXPECT_DOUBLE_EQ(linear.Segment(0, 0)(0.5), 1);
  EXPECT_DOUBLE_EQ(linear.Segment(0, 1)(1.0), 4);
  EXPECT_DOUBLE_EQ(linear.Segment(1, 1)(0.0), 1);
  EXPECT_DOUBLE_EQ(linear.Segment(2, 1)(0.5), -0.5);
  const Signal zero = Signal::FromRecord(record, Hold::kZero, 2);
  EXPECT_EQ(zero.Segment(0, 1)(1.0), 0);
  EXPECT_EQ(zero.Segment(1, 0)(0.3), 4);
  EXPECT_EQ(zero.Segment(5, 1)(0.99), -2);
  for (Eigen::Index t = 0; t < 6; ++t) {
    EXPECT_EQ(zero.AtSample(t), record[static_cast<size_t>(t % 3)]);
    EXPECT_EQ(linear.AtSample(t), record[static_cast<size_t>(t % 3)]);
  }
}

TEST(SignalTest, ASineIsEvaluatedFromItsFirstSample) {
  const Signal sine = Signal::Sine(120, 1.0 / 750, -100, 300, 8);
  EXPECT_EQ(sine.AtSample(100), 0);
  for (const Eigen::Index t : {0, 99, 250}) {
    const double time = static_cast<double>(t - 100) + 3.3 / 8;
    EXPECT_NEAR(sine.Segment(t, 3)(0.3), 120 * std::sin(2 * kPi * time / 750), 1e-11);
  }
}

TEST(SignalTest, HoldsAreKnownByName) {
  EXPECT_EQ(*ParseHold("band-limited"), Hold::kBandLimited);
  EXPECT_EQ(*ParseHold("linear"), Hold::kLinear);
  EXPECT_EQ(*ParseHold("zero"), Hold::kZero);
  EXPECT_EQ(ParseHold("first").status().code(), absl::StatusCode::kInvalidArgument);
}

}  // namespace
}  // namespace metaekf::sim
