#pragma once

#include <Eigen/Core>

#include "core/nn/parameters.h"

namespace metaekf::nssm {

/// What a fleet says of a system of which nothing is known yet: ω ~ N(ω₀, Λ⁻¹) with ω₀ the model's own parameters.
/// Normalised units; unknowns in the order of ω, adapted tensors only.
struct GaussianPrior {
  Eigen::MatrixXd dynamics;  ///< Λ
  Eigen::MatrixXd start;     ///< where the start is fitted: of c₀ ~ N(0, start⁻¹); else empty
  /// Where the start is fitted: ψ_s ≈ G [window; 1] at the window's first sample, from where StartFit begins.
  Eigen::MatrixXd start_guess;
  /// Variance that remains in every channel (states in Case II, then outputs).
  Eigen::VectorXd noise_variance;
  /// Fits of systems of the fleet, one a column: where the fit of a new one may start. Rows as those of `dynamics`.
  Eigen::MatrixXd examples;
  /// V of a fleet whose systems differ along R directions alone, ω = ω₀ + V z with z ~ N(0, I), p × R; else empty.
  Eigen::MatrixXd loadings;
};

/// What is known of the parameters of a system after its context (Laplace): ω ~ N(ω_MAP, information⁻¹). Units and order as
/// those of GaussianPrior; an unknown start is integrated out.
struct GaussianPosterior {
  Eigen::MatrixXd information;  ///< symmetric, positive definite
  /// Under a prior with loadings: z, which the information is of then; ω is AlongLoadings. Else empty.
  Eigen::VectorXd coordinates;
  nn::Mask mask;  ///< tensors that ω is of
};

/// ω₀ + V z, of the adapted parameters.
Eigen::VectorXd AlongLoadings(const GaussianPrior& prior, const Eigen::VectorXd& mean, const Eigen::VectorXd& coordinates);

}  // namespace metaekf::nssm
