#pragma once

#include <functional>
#include <vector>

#include "core/meta/map_fit.h"

namespace metaekf::meta {

struct ProximalFitOptions {
  double proximal = 1;  ///< λ, positive
  int32_t steps = 10;   ///< of Levenberg–Marquardt, at most
  /// Ends when steps keep bringing less than this share of the minimum's value; its square root is about how near they are
  /// then. Below 1e-13 rounding does not tell better from worse.
  double tolerance = 1e-10;
};

/// argmin_a L(𝓒; a) + ½ λ |a − a₀|² over the adapted parameters a, the inner problem of IMPLICIT_MAML, by
/// Levenberg–Marquardt with exact sensitivities.
///
/// L is a weighted mean of squares, w_y Σ r_y²/(n_y N) + w_x Σ r_x²/(n_x N) over N predicted samples; so it is the
/// likelihood of FitMap with the noise variance n N/(2 w) in every channel, and the pull a belief of precision λ I.
///
/// @param problem  without a free start. @param loss  the one of `problem`, no term of reconstruction: it has no rows there.
/// @param start    ω₀, all of it.
/// @return its cost is the minimum's value, loss and pull; no number or infinite if the rollouts from ω₀ leave the numbers.
MapFit FitProximal(const nssm::RolloutLeastSquares& problem, const nssm::LossSpec& loss, const nssm::LossData<double>& data,
                   const std::vector<double>& start, const ProximalFitOptions& options,
                   nssm::RolloutLeastSquares::Workspace* workspace,
                   const OnIteration& on_iteration = nullptr);

/// 1/w of every channel under which Φ of RolloutLeastSquares is L. Infinite where L does not look at the channel.
Eigen::VectorXd VarianceOfLoss(const nssm::RolloutLeastSquares& problem, const nssm::LossSpec& loss,
                               const nssm::LossData<double>& data);

}  // namespace metaekf::meta
