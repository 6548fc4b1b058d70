#pragma once

#include <Eigen/Core>

#include "core/nssm/bundle.h"

namespace metaekf::filter {

/// Most of the directions that a filter follows.
inline constexpr Eigen::Index kMostDirections = 8;

/// What an adaptation has left open of a system's parameters: ω = ω̂ + V z, z ~ N(0, I), along the directions in which the posterior
/// is widest, of those in which the systems of the fleet differ: along others it may be as wide as the prior because they do nothing.
///
/// @return V, n_ω × r, r at most kMostDirections, zero where nothing adapts; without columns for a model that has no posterior, or one
///   that is not positive definite.
Eigen::MatrixXd UnknownDirections(const nssm::Bundle& bundle);

}  // namespace metaekf::filter
