#pragma once

#include <Eigen/Core>
#include <array>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/rng.h"

namespace metaekf::sim {

/// What a recorded signal is between its samples.
enum class Hold {
  kBandLimited,  ///< the trigonometric interpolant of the record, taken as one period
  kLinear,       ///< straight from sample to sample
  kZero,         ///< each sample until the next
};

/// "band-limited", "linear" or "zero". Errors: InvalidArgument, with the three names.
absl::StatusOr<Hold> ParseHold(const std::string& text);

/// A polynomial of degree 4 over one segment of a signal, its time running from 0 to 1.
struct Quartic {
  std::array<double, 5> coefficients;

  double operator()(double time) const {
    const auto& c = coefficients;
    return c[0] + time * (c[1] + time * (c[2] + time * (c[3] + time * c[4])));
  }
};

/// A scalar signal of continuous time that an integrator can evaluate between samples.
///
/// It is tabulated four times per segment, with a whole number of segments from sample to sample,
/// and is the quartic through the five values within each; a held signal (Hold::kZero) is constant
/// instead. With 4 segments per sample that is a sine of 0.2 cycles per sample to 1e-7 of its
/// amplitude. After its last sample it begins again.
class Signal {
 public:
  /// The samples of `record`, held as `hold` says; band-limited, the record is one period.
  static Signal FromRecord(const std::vector<double>& record, Hold hold, int segments_per_sample);

  /// amplitude · sin(2π · cycles_per_sample · (t + first_sample)), for `samples` samples from t =
  /// 0.
  static Signal Sine(double amplitude, double cycles_per_sample, Eigen::Index first_sample,
                     Eigen::Index samples, int segments_per_sample);

  double AtSample(Eigen::Index sample) const {
    return values_[static_cast<size_t>(4 * segments_per_sample_ * sample) % values_.size()];
  }
  Quartic Segment(Eigen::Index sample, int segment) const;
  int segments_per_sample() const { return segments_per_sample_; }

 private:
  Signal(std::vector<double> values, int segments_per_sample, bool stepwise)
      : values_(std::move(values)),
        segments_per_sample_(segments_per_sample),
        stepwise_(stepwise) {}

  std::vector<double> values_;
  int segments_per_sample_;
  bool stepwise_;
};

/// One period of a random-phase multisine: every multiple of 1/period in the band with the same
/// amplitude and a phase of its own, uniform on the circle, and nothing else,
///
///   u_t = Σ_k rms √(2/K) cos(2π k t / period + φ_k),   band_min ≤ k / period ≤ band_max,
///
/// K the number of such k. Frequencies are in cycles per sample. Its band-limited interpolation is
/// the multisine in continuous time.
///
/// Errors: InvalidArgument if no k lies in the band, or one is 0 or not below half a cycle per
/// sample.
absl::StatusOr<std::vector<double>> DrawMultisine(double band_min, double band_max, double rms,
                                                  Eigen::Index period, base::Rng& rng);

}  // namespace metaekf::sim
