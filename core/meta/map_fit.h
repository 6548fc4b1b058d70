#pragma once

#include <Eigen/Core>
#include <functional>
#include <optional>
#include <vector>

#include "core/meta/levenberg_marquardt.h"
#include "core/nssm/least_squares.h"

namespace metaekf::meta {

/// What is believed of the unknowns of a fit before its data are seen: N(mean, precision⁻¹), and the noise of every
/// channel. In normalised units; unknowns as RolloutLeastSquares orders them.
struct Belief {
  Eigen::VectorXd mean;
  Eigen::MatrixXd precision;       ///< Λ, symmetric
  Eigen::VectorXd noise_variance;  ///< σ², one per channel; infinite: the channel is not used
};

/// The most probable unknowns of one system, and how sure they are.
struct MapFit {
  Eigen::VectorXd unknowns;
  Eigen::VectorXd coordinates;     ///< along the directions that were free, where not all are
  /// Λ + Jᵀ W J at the optimum, the inverse of the posterior covariance (Laplace): of the unknowns, or of the coordinates.
  Eigen::MatrixXd information;
  Eigen::VectorXd noise_variance;  ///< as estimated from the residuals, with the belief's worth `noise_samples` samples
  Eigen::VectorXd channel_squares; ///< Σ r² of every channel
  double cost = 0;                 ///< what was minimised
  int iterations = 0;
  double damping = 0;  ///< for a fit that goes on from here
  bool converged = false;
  bool stopped = false;
};

/// A plane that the unknowns lie in: m + B z with z ~ N(0, Λ_z⁻¹).
struct Directions {
  Eigen::MatrixXd basis;      ///< B, n × k, of full rank
  Eigen::MatrixXd precision;  ///< Λ_z, k × k, symmetric: what is believed of z, instead of the belief's Λ
};

struct MapFitOptions {
  LevenbergMarquardtOptions optimiser;
  /// How many samples' worth of evidence the belief's noise variance counts for; infinite: it is not estimated.
  double noise_samples = std::numeric_limits<double>::infinity();
  /// Nothing: all unknowns are free.
  std::optional<Directions> directions;
};

/// z of the m + B z that is the most probable of all near x: the least (x − m − B z)ᵀ Λ (x − m − B z).
Eigen::VectorXd CoordinatesNear(const Belief& belief, const Eigen::MatrixXd& directions, const Eigen::VectorXd& x);

/// Minimises ½ Σ_c Σ r_c²/σ_c² + ½ (θ − m)ᵀ Λ (θ − m) over the unknowns θ; along directions, with ½ zᵀ Λ_z z instead.
///
/// @param parameters  ω, of which the adapted part is not read.
/// @param from        where to start; with directions at what is near it.
MapFit FitMap(const nssm::RolloutLeastSquares& problem, const nssm::LossData<double>& data,
              const std::vector<double>& parameters, const Belief& belief, const Eigen::VectorXd& from,
              const MapFitOptions& options, nssm::RolloutLeastSquares::Workspace* workspace,
              const OnIteration& on_iteration = nullptr);

/// Puts the adapted part of `unknowns` into ω, and the other way round.
void ScatterAdapted(const nssm::RolloutLeastSquares& problem, const Eigen::VectorXd& unknowns,
                    std::vector<double>* parameters);
Eigen::VectorXd GatherAdapted(const nssm::RolloutLeastSquares& problem, const std::vector<double>& parameters);

}  // namespace metaekf::meta
