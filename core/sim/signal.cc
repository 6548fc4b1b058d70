#include "core/sim/signal.h"

#include <cmath>
#include <complex>
#include <numbers>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "core/sim/fourier.h"

namespace metaekf::sim {
namespace {

/// The polynomial through `values` at times 0, ¼, ½, ¾ and 1, by Newton's forward differences.
Quartic Interpolate(const std::array<double, 5>& values) {
  const auto& [a, b, c, d, e] = values;
  const double d1 = b - a;
  const double d2 = c - 2 * b + a;
  const double d3 = d - 3 * c + 3 * b - a;
  const double d4 = e - 4 * d + 6 * c - 4 * b + a;
  return {{a, 4 * (d1 - d2 / 2 + d3 / 3 - d4 / 4), 16 * (d2 / 2 - d3 / 2 + 11 * d4 / 24),
           64 * (d3 / 6 - d4 / 4), 256 * (d4 / 24)}};
}

}  // namespace

absl::StatusOr<Hold> ParseHold(const std::string& text) {
  if (text == "band-limited") return Hold::kBandLimited;
  if (text == "linear") return Hold::kLinear;
  if (text == "zero") return Hold::kZero;
  return absl::InvalidArgumentError(
      absl::StrCat("hold \"", text, "\" is none of band-limited, linear, zero"));
}

Signal Signal::FromRecord(const std::vector<double>& record, Hold hold, int segments_per_sample) {
  const size_t factor = 4 * static_cast<size_t>(segments_per_sample);
  if (hold == Hold::kBandLimited) {
    return Signal(InterpolateBandLimited(record, factor), segments_per_sample, false);
  }
  std::vector<double> values;
  values.reserve(record.size() * factor);
  for (size_t t = 0; t < record.size(); ++t) {
    const double step = hold == Hold::kZero ? 0 : record[(t + 1) % record.size()] - record[t];
    for (size_t i = 0; i < factor; ++i) {
      values.push_back(record[t] + step * static_cast<double>(i) / static_cast<double>(factor));
    }
  }
  return Signal(std::move(values), segments_per_sample, hold == Hold::kZero);
}

Signal Signal::Sine(double amplitude, double cycles_per_sample, Eigen::Index first_sample,
                    Eigen::Index samples, int segments_per_sample) {
  const Eigen::Index factor = 4 * segments_per_sample;
  std::vector<double> values(static_cast<size_t>(samples * factor));
  for (size_t i = 0; i < values.size(); ++i) {
    const double time =
        static_cast<double>(first_sample) + static_cast<double>(i) / static_cast<double>(factor);
    values[i] = amplitude * std::sin(2 * std::numbers::pi * cycles_per_sample * time);
  }
  return Signal(std::move(values), segments_per_sample, false);
}

Quartic Signal::Segment(Eigen::Index sample, int segment) const {
  const size_t first =
      static_cast<size_t>(4 * (sample * segments_per_sample_ + segment)) % values_.size();
  const double* const values = &values_[first];
  if (stepwise_) return {{values[0], 0, 0, 0, 0}};
  const double next = first + 4 == values_.size() ? values_[0] : values[4];
  return Interpolate({values[0], values[1], values[2], values[3], next});
}

absl::StatusOr<std::vector<double>> DrawMultisine(double band_min, double band_max, double rms,
                                                  Eigen::Index period, base::Rng& rng) {
  // A bin on the edge of the band belongs to it, though the product may come out a rounding beyond.
  const double samples = static_cast<double>(period);
  const auto first = static_cast<Eigen::Index>(std::ceil(band_min * samples * (1 - 1e-12)));
  const auto last = static_cast<Eigen::Index>(std::floor(band_max * samples * (1 + 1e-12)));
  if (first < 1 || 2 * last >= period) {
    return absl::InvalidArgumentError(
        "a multisine's band must lie above 0 and below half the sampling rate");
  }
  if (last < first) {
    return absl::InvalidArgumentError(absl::StrCat("no multiple of 1/", period,
                                                   " of the sampling rate lies in the band; give a "
                                                   "wider band or a longer period"));
  }
  const double amplitude = rms * std::sqrt(2.0 / static_cast<double>(last - first + 1));
  std::vector<std::complex<double>> spectrum(static_cast<size_t>(period / 2 + 1));
  for (Eigen::Index k = first; k <= last; ++k) {
    spectrum[static_cast<size_t>(k)] =
        std::polar(0.5 * amplitude * samples, rng.Uniform(0, 2 * std::numbers::pi));
  }
  return RealFourier(static_cast<size_t>(period)).Inverse(spectrum);
}

}  // namespace metaekf::sim
