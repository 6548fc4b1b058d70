#pragma once

#include <Eigen/Core>

#include "core/physics/polyhedron.h"

namespace metaekf::filter {

/// What a constraint has done to an estimate, in the units of the state.
struct ConstraintEffect {
  double slack = 0;       ///< before, see Slack
  double projection = 0;  ///< how far the mean was moved; 0 where it was inside
};

/// Puts the estimate N(x, L Lᵀ) of a state that is known to lie in a set inside it.
///
///   x⁺ = argmin (ξ − x)ᵀ P⁻¹ (ξ − x) under G ξ ≤ g      physics::Project
///   P⁺ = P − Σ (1 − ρ) P a aᵀ P / (aᵀ P a)              for the rows a of G that hold x⁺ back, one after the other
///
/// The mean goes to an edge of the set, so P⁺ is the mean square error about that edge: for the component of the error along a,
/// with x outside by α = (aᵀ x − g)/√(aᵀ P a), it is E[t² | t > 0] of t ~ N(−α, 1),
///
///   ρ(α) = 1 + α² − α φ(α)/Φ(−α).
///
/// ρ(0) = 1, so that an estimate on the edge is left as it is, and ρ falls as 2/α²: what is far outside is surely near the edge.
///
/// @param set  in the units of the mean. @param mean  x, n. @param factor  L, n × n; lower triangle on return.
/// Allocates only where the mean is outside.
/// Source: the projection is paper.tex's alternative to eq. ae_based_proj; the covariance is ours.
ConstraintEffect Constrain(const physics::Polyhedron& set, Eigen::VectorXd* mean, Eigen::MatrixXd* factor);

/// The distance to the nearest plane, negative outside: min_i (g_i − G_i x)/|G_i|; infinite without one.
double Slack(const physics::Polyhedron& set, const Eigen::VectorXd& x);

/// ρ(α), α ≥ 0.
double EdgeVariance(double alpha);

/// A set in normalised units, x = mean + scale ∘ x̃: G diag(scale) x̃ ≤ g − G mean.
physics::Polyhedron InUnits(const physics::Polyhedron& set, const Eigen::VectorXd& mean, const Eigen::VectorXd& scale);

/// The set of [x; z] with x in a set and r free components z.
physics::Polyhedron WithFree(const physics::Polyhedron& set, Eigen::Index r);

}  // namespace metaekf::filter
