#include "core/sim/fourier.h"

#include <cassert>
#include <cmath>
#include <numbers>
#include <unsupported/Eigen/FFT>

namespace metaekf::sim {
namespace {

using Complex = std::complex<double>;

constexpr double kPi = std::numbers::pi;
/// Eigen's transform takes a time of n · p for the prime factor p; above this Bluestein's is
/// faster.
constexpr size_t kLargestDirectFactor = 61;

size_t LargestPrimeFactor(size_t n) {
  size_t largest = 1;
  for (size_t p = 2; p * p <= n; ++p) {
    for (; n % p == 0; n /= p) largest = p;
  }
  return n > 1 ? n : largest;
}

}  // namespace

struct RealFourier::Plan {
  Eigen::FFT<double> fft;
  // Only for Bluestein's algorithm, empty otherwise: e^(−πi k²/n), and the transform of its
  // conjugate, laid around zero in a circle of a power of two.
  std::vector<Complex> chirp;
  std::vector<Complex> filter;
};

RealFourier::RealFourier(size_t n) : n_(n), plan_(std::make_unique<Plan>()) {
  assert(n > 0);
  plan_->fft.SetFlag(Eigen::FFT<double>::HalfSpectrum);
  if (LargestPrimeFactor(n) <= kLargestDirectFactor) return;
  size_t size = 1;
  while (size < 2 * n - 1) size *= 2;
  plan_->chirp.resize(n);
  std::vector<Complex> circle(size, Complex(0, 0));
  for (size_t k = 0; k < n; ++k) {
    // k² modulo 2n, which the phase has as its period, keeps the argument small and so exact.
    const double phase = kPi * static_cast<double>(k * k % (2 * n)) / static_cast<double>(n);
    plan_->chirp[k] = std::polar(1.0, -phase);
    circle[k] = std::conj(plan_->chirp[k]);
    if (k > 0) circle[size - k] = circle[k];
  }
  plan_->fft.fwd(plan_->filter, circle);
}

RealFourier::~RealFourier() = default;

/// kt = (k² + t² − (k − t)²) / 2 turns the transform into a convolution with the chirp.
std::vector<Complex> RealFourier::Bluestein(const std::vector<Complex>& signal) {
  std::vector<Complex> padded(plan_->filter.size(), Complex(0, 0)), product;
  for (size_t t = 0; t < n_; ++t) padded[t] = signal[t] * plan_->chirp[t];
  plan_->fft.fwd(product, padded);
  for (size_t k = 0; k < product.size(); ++k) product[k] *= plan_->filter[k];
  plan_->fft.inv(padded, product);
  std::vector<Complex> spectrum(n_);
  for (size_t k = 0; k < n_; ++k) spectrum[k] = padded[k] * plan_->chirp[k];
  return spectrum;
}

std::vector<Complex> RealFourier::Forward(const std::vector<double>& signal) {
  assert(signal.size() == n_);
  if (n_ == 1) return {signal[0]};  // Eigen's transform fails on one value
  std::vector<Complex> spectrum;
  if (plan_->chirp.empty()) {
    plan_->fft.fwd(spectrum, signal);
  } else {
    spectrum = Bluestein(std::vector<Complex>(signal.begin(), signal.end()));
  }
  spectrum.resize(n_ / 2 + 1);
  return spectrum;
}

std::vector<double> RealFourier::Inverse(const std::vector<Complex>& spectrum) {
  assert(spectrum.size() == n_ / 2 + 1);
  if (n_ == 1) return {spectrum[0].real()};
  std::vector<double> signal(n_);
  if (plan_->chirp.empty()) {
    plan_->fft.inv(signal, spectrum, static_cast<Eigen::Index>(n_));
    return signal;
  }
  // The inverse is the forward transform of the conjugate spectrum, whose second half mirrors the
  // first.
  std::vector<Complex> conjugate(n_);
  for (size_t k = 0; k < spectrum.size(); ++k) {
    conjugate[k] = std::conj(spectrum[k]);
    if (k > 0) conjugate[n_ - k] = spectrum[k];
  }
  const std::vector<Complex> sum = Bluestein(conjugate);
  for (size_t t = 0; t < n_; ++t) signal[t] = sum[t].real() / static_cast<double>(n_);
  return signal;
}

std::vector<double> InterpolateBandLimited(const std::vector<double>& signal, size_t factor) {
  const size_t n = signal.size();
  RealFourier fourier(n);
  const std::vector<Complex> spectrum = fourier.Forward(signal);
  // One short transform per offset, each of the spectrum turned by that offset, is several times
  // faster than one long transform padded with zeros.
  std::vector<Complex> turned(spectrum.size());
  std::vector<double> fine(n * factor);
  for (size_t offset = 0; offset < factor; ++offset) {
    const double shift = static_cast<double>(offset) / static_cast<double>(factor);
    const Complex turn = std::polar(1.0, 2 * kPi * shift / static_cast<double>(n));
    Complex phase(1, 0);
    for (size_t k = 0; k < spectrum.size(); ++k) {
      turned[k] = spectrum[k] * phase;
      phase *= turn;
    }
    if (n % 2 == 0) turned[n / 2] = spectrum[n / 2].real() * std::cos(kPi * shift);
    const std::vector<double> values = offset == 0 ? signal : fourier.Inverse(turned);
    for (size_t t = 0; t < n; ++t) fine[t * factor + offset] = values[t];
  }
  return fine;
}

}  // namespace metaekf::sim
