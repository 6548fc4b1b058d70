#pragma once

#include <cstdint>
#include <vector>

#include "core/autodiff/graph.h"

namespace metaekf::physics {

/// A vector field without curl: h = ∇_p φ, the gradient of a scalar potential.
///
///   h_i = ∂φ(x) / ∂x_{p_i}
///
/// @param potential  φ, 1 × b, a value computed from `state`, each column from its own.
/// @param state      x, n_x × b.
/// @param positions  p, the components of x that are coordinates.
/// @return h, |p| × b: one component per coordinate.
///
/// The curl is zero to rounding, whatever the weights, because second derivatives commute; the activations
/// on the way must be twice continuously differentiable.
/// Source: paper.tex eq. h_bar, theorem thm:1.
autodiff::Value CurlFree(autodiff::Graph* graph, autodiff::Value potential, autodiff::Value state,
                         const std::vector<int32_t>& positions);

}  // namespace metaekf::physics
