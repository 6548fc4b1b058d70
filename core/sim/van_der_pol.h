#pragma once

#include "core/sim/system.h"

namespace metaekf::sim {

/// The unforced van der Pol oscillator, discretised by forward Euler with Δ = 0.01 s:
///
///   x₁⁺ = x₁ + Δ x₂
///   x₂⁺ = x₂ + Δ (θ x₂ (1 − x₁²) − x₁),   y = x + noise.
///
/// θ and both initial states are its parameters; a length that is not given is drawn uniformly from
/// 10 to 40 s. Nominal values are the paper's target system.
///
/// Source: paper.tex eq. vdp.
const System& VanDerPol();

}  // namespace metaekf::sim
