#pragma once

#include <Eigen/Core>
#include <vector>

#include "absl/status/status.h"
#include "core/meta/inner_loop.h"

namespace metaekf::meta {

/// Covariance of few factors and what each parameter does on its own: Σ = V Vᵀ + D.
struct FactorModel {
  Eigen::MatrixXd loadings;  ///< V, p × R
  Eigen::VectorXd diagonal;  ///< D, positive
  std::vector<double> log_likelihoods;  ///< ℓ of every iteration's start, the last of the end

  Eigen::MatrixXd Covariance() const;
  /// Σ⁻¹ = D⁻¹ − D⁻¹ V (I + Vᵀ D⁻¹ V)⁻¹ Vᵀ D⁻¹.
  Eigen::MatrixXd Precision() const;
};

struct FactorOptions {
  int max_iterations = 200;
  double tolerance = 1e-5;  ///< ends when no element of D moves by more than this share of itself
};

/// Factor analysis of a second moment C by maximum likelihood, ℓ(Σ) = −½ (log |Σ| + tr Σ⁻¹ C), one part after the other:
///
///   V given D   With D^{−½} C D^{−½} = U Θ Uᵀ the best is V = D^{½} U_R (Θ_R − I)^{½} of the R largest θ, those below 1
///               counting as 1, and there −2 ℓ = Σ_j log d_j + Σ_{i: θ_i in V} (log θ_i + 1) + Σ_{the others} θ_i.
///   d_j given all else   With K = Σ⁻¹ a change of δ makes −2 ℓ larger by log(1 + δ K_jj) − δ (K C K)_jj / (1 + δ K_jj),
///               which falls up to δ = ((K C K)_jj / K_jj − 1) / K_jj and rises from there. K follows by a rank-one update.
///
/// So ℓ never falls, and both parts are exact where EM would take thousands of small steps. No d_j goes below 1e-6 C_jj: the
/// likelihood may want it at zero (Heywood's case), and Σ has to stay invertible.
///
/// @param second_moment  C, p × p, symmetric, its diagonal positive. @param rank  R, from 1 to p.
/// Source: the first part is K. G. Jöreskog, Some Contributions to Maximum Likelihood Factor Analysis, 1967; the second
/// follows from the matrix determinant and inversion lemmas.
FactorModel FitFactors(const Eigen::MatrixXd& second_moment, Eigen::Index rank, const FactorOptions& options = {});

struct StructuredCovariance {
  Eigen::MatrixXd covariance;
  Eigen::MatrixXd loadings;  ///< V, those of its columns that are not zero; empty where there are no factors
};

/// The most likely covariance of the structure that a prior is given, from the second moment C of a fleet's parameters:
/// C itself (kFull), its blocks of each tensor (kBlock), V Vᵀ + D (kLowRank and kManifold, FitFactors). All maximise ℓ above.
///
/// @param tensors  what adapts, piece by piece; their sizes add up to p.
StructuredCovariance FitStructure(const GaussianPriorSpec& spec, const nn::Pieces& tensors, const Eigen::MatrixXd& second_moment);

/// Errors: InvalidArgument naming gaussian_prior.rank if it exceeds the number of parameters that adapt.
absl::Status CheckStructure(const GaussianPriorSpec& spec, Eigen::Index parameters);

}  // namespace metaekf::meta
