#pragma once

#include <cstdint>

namespace metaekf::filter {

enum class Health {
  kWarmingUp,       ///< before the first window is full: no estimate yet
  kConsistent,      ///< innovations are as large as their covariance says
  kOverconfident,   ///< they are larger: bounds are too narrow
  kUnderconfident,  ///< they are smaller: bounds are too wide
  kDiverged,        ///< a value is not finite: do not use
};

/// Watches whether innovations are as large as their covariance says.
///
/// The NIS of m measured components is χ² with m degrees of freedom. Its mean over the last hundred samples or so, per component, is
/// compared with what χ² allows at 99.9 %, and with the factors [0.82, 1.17] that put the share of a 95 % bound at 97 % or 93 %:
/// outside both the filter is called over- or underconfident.
struct NisMonitor {
  double nis = 0, measured = 0;  ///< exponentially weighted means of the NIS and of m
  int64_t samples = 0;

  void Add(double sample_nis, int sample_measured);
  /// Mean NIS per component; 1 before the first sample.
  double Ratio() const { return measured > 0 ? nis / measured : 1; }
  /// kConsistent, kOverconfident or kUnderconfident.
  Health Judge() const;
};

}  // namespace metaekf::filter
