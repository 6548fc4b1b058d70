#pragma once

#include <utility>
#include <vector>

#include "core/autodiff/graph.h"

namespace metaekf::autodiff {

/// A value and its tangent (forward) or cotangent (reverse).
struct Seed {
  Value value;
  Value derivative;
};

/// Appends the tangents of `outputs` along the seeds: forward mode, ẏ = Σ ∂y/∂v · v̇.
///
/// With k `directions`, the tangent of an n × b value is n × (k·b): k blocks side by side, so that one product
/// with a weight serves all of them. Parameters take tangents in one direction only, as do scans.
///
/// @return one value per output; kNoValue where the tangent is zero whatever the inputs.
std::vector<Value> Jvp(Graph* graph, const std::vector<Seed>& seeds, const std::vector<Value>& outputs,
                       int32_t directions = 1);

/// Appends the cotangents of `wrt`: reverse mode, v̄ = Σ (∂y/∂v)ᵀ · ȳ over the seeds (y, ȳ).
///
/// Only what lies between `wrt` and the seeds is differentiated: frozen layers cost nothing.
///
/// @return one value per element of `wrt`; kNoValue where the cotangent is zero whatever the inputs.
std::vector<Value> Vjp(Graph* graph, const std::vector<Seed>& seeds, const std::vector<Value>& wrt);

/// The gradient of a 1 × 1 value. Zero gradients are constants of the right shape.
std::vector<Value> Gradient(Graph* graph, Value scalar, const std::vector<Value>& wrt);

}  // namespace metaekf::autodiff
