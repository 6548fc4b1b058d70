#pragma once

#include <cstddef>

namespace metaekf::nssm {

/// One step of a sensitivity recursion, one component at a time: target = direct + Σ_i factors[i] · S_i, in vectors of the
/// widest kind that the machine has.
///
/// @param sensitivity  S, size × n, column after column: S_i = ∂(carry component i)/∂θ.
/// @param factors      n derivatives of the component with respect to the carry.
/// @param direct       size elements, ∂(component)/∂θ with the carry held.
void PropagateSensitivity(size_t size, size_t n, const double* sensitivity, const double* factors, const double* direct,
                          double* target);

}  // namespace metaekf::nssm
