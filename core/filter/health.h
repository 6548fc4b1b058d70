#pragma once

#include <Eigen/Core>
#include <cstdint>

namespace metaekf::filter {

enum class Health {
  kWarmingUp,       ///< before the first window is full: no estimate yet
  kConsistent,      ///< innovations are as large as their covariance says, and each is news
  kOverconfident,   ///< they are larger, or go on as the last: bounds are too narrow
  kUnderconfident,  ///< they are smaller: bounds are too wide
  kDiverged,        ///< a value is not finite: do not use
};

/// Watches whether innovations are as large as their covariance says, and independent of each other.
///
/// The NIS of m measured components is χ² with m degrees of freedom. Its mean over the last hundred samples or so, per component, is
/// compared with what χ² allows at 99.9 %, and with the factors [0.82, 1.17] that put the share of a 95 % bound at 97 % or 93 %:
/// outside both the filter is called over- or underconfident.
///
/// With w = L⁻¹ỹ, S = L Lᵀ, and what has come of the last ones, sₜ = λ sₜ₋₁ + wₜ with λ = 0.9, a consistent filter's wₜᵀsₜ₋₁ has mean 0 whatever
/// came before. Over N of them in the same memory
///   z = √(N m) mean of wₜᵀsₜ₋₁ / √(mean of ‖wₜ‖² mean of ‖sₜ₋₁‖²)
/// is standard normal, whatever the size of S. Beyond 99.95 % of it the filter corrects too little for what it sees: an error of its
/// state outlasts its covariance, which is overconfident, too, however small the NIS. A small share a of an innovation's variance that lasts with φ a
/// sample moves z by √(N m) a φ √(1 − λ²)/(1 − λφ): for φ = 0.95 three times as much as beside the last innovation alone (λ = 0).
/// Source: Mehra, "On the identification of variances and adaptive Kalman filtering", 1970, for tests of whiteness; the weights are ours.
struct NisMonitor {
  double nis = 0, measured = 0;  ///< exponentially weighted means of the NIS and of m
  double correlation = 0, past_square = 0;  ///< of wₜᵀsₜ₋₁ and ‖sₜ₋₁‖²
  int64_t samples = 0, pairs = 0;
  Eigen::VectorXd past;          ///< s, of the samples that were measured and believed as a whole; 0 before

  NisMonitor() = default;
  explicit NisMonitor(Eigen::Index outputs);
  /// @param whitened  w; empty unless all of y was measured and believed.
  void Add(double sample_nis, int sample_measured, const Eigen::Ref<const Eigen::VectorXd>& whitened = Eigen::VectorXd());
  /// Mean NIS per component; 1 before the first sample.
  double Ratio() const { return measured > 0 ? nis / measured : 1; }
  /// Whether innovations go on as the last.
  bool Correlated() const;
  /// kConsistent, kOverconfident or kUnderconfident.
  Health Judge() const;
};

}  // namespace metaekf::filter
