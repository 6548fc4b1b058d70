#pragma once

#include <complex>
#include <cstddef>
#include <memory>
#include <vector>

namespace metaekf::sim {

/// The discrete Fourier transform of real signals of one length, whatever its factors.
///
///   X_k = Σ_t x_t e^(−2πi kt/n),   k = 0 … ⌊n/2⌋        Forward
///   x_t = (1/n) Σ_k X_k e^(2πi kt/n),  X_{n−k} = X̄_k    Inverse
///
/// O(n log n): directly where n has small prime factors only, by Bluestein's convolution otherwise.
/// An object serves one thread at a time.
class RealFourier {
 public:
  /// Prepares for signals of n ≥ 1 values.
  explicit RealFourier(size_t n);
  ~RealFourier();

  /// x (n) to X (⌊n/2⌋ + 1).
  std::vector<std::complex<double>> Forward(const std::vector<double>& signal);
  /// X (⌊n/2⌋ + 1) to x (n). The imaginary parts of X_0 and, for even n, of X_{n/2} must be zero.
  std::vector<double> Inverse(const std::vector<std::complex<double>>& spectrum);

 private:
  struct Plan;

  std::vector<std::complex<double>> Bluestein(const std::vector<std::complex<double>>& signal);

  size_t n_;
  std::unique_ptr<Plan> plan_;
};

/// Trigonometric interpolation: `signal`, taken as one period, at `factor` evenly spaced times from
/// each value to the next; every factor-th result is the signal itself. Content at half the
/// sampling rate is taken as a cosine. Both sizes must be positive.
std::vector<double> InterpolateBandLimited(const std::vector<double>& signal, size_t factor);

}  // namespace metaekf::sim
