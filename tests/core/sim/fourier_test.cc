#include "core/sim/fourier.h"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>

#include "core/base/rng.h"

namespace metaekf::sim {
namespace {

using Complex = std::complex<double>;

constexpr double kPi = std::numbers::pi;

std::vector<double> RandomSignal(size_t n) {
  base::Rng rng(n);
  std::vector<double> signal(n);
  for (double& value : signal) value = rng.Normal();
  return signal;
}

/// X_k by the definition, in O(n).
Complex ByDefinition(const std::vector<double>& signal, size_t k) {
  const size_t n = signal.size();
  Complex sum(0, 0);
  for (size_t t = 0; t < n; ++t) {
    sum +=
        std::polar(signal[t], -2 * kPi * static_cast<double>(k * t % n) / static_cast<double>(n));
  }
  return sum;
}

// Powers of two, small factors, odd lengths, and primes (67, 127, 1009) that take Bluestein's way.
constexpr size_t kLengths[] = {1, 2, 3, 4, 8, 15, 61, 67, 127, 134, 750, 1009, 1024};

TEST(FourierTest, ForwardIsTheDefinition) {
  for (const size_t n : kLengths) {
    const std::vector<double> signal = RandomSignal(n);
    const std::vector<Complex> spectrum = RealFourier(n).Forward(signal);
    ASSERT_EQ(spectrum.size(), n / 2 + 1);
    for (size_t k = 0; k < spectrum.size(); ++k) {
      EXPECT_NEAR(std::abs(spectrum[k] - ByDefinition(signal, k)), 0,
                  1e-13 * static_cast<double>(n))
          << n << " " << k;
    }
  }
}

TEST(FourierTest, InverseUndoesForward) {
  for (const size_t n : kLengths) {
    const std::vector<double> signal = RandomSignal(n);
    RealFourier fourier(n);
    const std::vector<double> back = fourier.Inverse(fourier.Forward(signal));
    ASSERT_EQ(back.size(), n);
    for (size_t t = 0; t < n; ++t) EXPECT_NEAR(back[t], signal[t], 1e-13) << n << " " << t;
  }
}

TEST(FourierTest, InterpolatesSinesExactly) {
  // A sum of sines below half the sampling rate is its own interpolant: evaluate it at the fine
  // times.
  for (const size_t n : {64u, 75u, 67u}) {
    const auto value = [n](double time) {
      const double angle = 2 * kPi * time / static_cast<double>(n);
      return 1.5 + std::cos(3 * angle + 0.4) - 2 * std::sin(31 * angle);
    };
    std::vector<double> signal(n);
    for (size_t t = 0; t < n; ++t) signal[t] = value(static_cast<double>(t));
    const std::vector<double> fine = InterpolateBandLimited(signal, 12);
    ASSERT_EQ(fine.size(), 12 * n);
    for (size_t i = 0; i < fine.size(); ++i) {
      EXPECT_NEAR(fine[i], value(static_cast<double>(i) / 12), 1e-12) << n << " " << i;
    }
  }
}

TEST(FourierTest, HalfTheSamplingRateIsACosine) {
  const std::vector<double> fine = InterpolateBandLimited({1, -1, 1, -1}, 4);
  for (size_t i = 0; i < fine.size(); ++i) {
    EXPECT_NEAR(fine[i], std::cos(kPi * static_cast<double>(i) / 4), 1e-15);
  }
}

TEST(FourierTest, InterpolationKeepsTheSignalBitForBit) {
  for (const size_t n : {1u, 67u, 1024u}) {
    const std::vector<double> signal = RandomSignal(n);
    const std::vector<double> fine = InterpolateBandLimited(signal, 8);
    for (size_t t = 0; t < n; ++t) EXPECT_EQ(fine[8 * t], signal[t]);
  }
}

}  // namespace
}  // namespace metaekf::sim
