#pragma once

#include <vector>

#include "core/nssm/bundle.h"

namespace metaekf::filter {

/// Residuals e_t split into what lasts and what does not.
struct SplitErrors {
  nssm::GaussMarkov lasting;
  Eigen::MatrixXd white;  ///< covariance of the rest, positive definite
};

/// From second moments C_k = E[e_{t+k} e_tᵀ], which are φ^k B + [k = 0] N where B is the covariance of a Gauss–Markov process and N that
/// of white noise:
///
///   φ          that for which φ^k, k = 1 … K, times a factor is nearest to the mean autocorrelation of the channels
///   B          Σ_k φ^k (C_k + C_kᵀ)/2 / Σ_k φ^{2k}
///   W Wᵀ       B along the directions u of C_0^{−½} B C_0^{−½} in which it is a tenth of all at least (its eigenvalue λ), at most
///              kMostLastingErrors of them, those with the largest |C_0^½ u|² λ; λ is at most 0.99, so that N = C_0 − W Wᵀ is positive definite
///
/// @param moments  C_0 … C_K, K ≥ 1; C_0 positive definite.
/// Source: the method of moments (Yule–Walker's equations with white noise on top); the choice of directions is ours.
SplitErrors SplitByDuration(const std::vector<Eigen::MatrixXd>& moments);

inline constexpr Eigen::Index kMostLastingErrors = 8;

}  // namespace metaekf::filter
