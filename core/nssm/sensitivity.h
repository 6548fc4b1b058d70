#pragma once

#include <cstddef>

namespace metaekf::nssm {

/// A part a_t b_tᵀ of what depends on θ directly, ∂(component)/∂θ with the carry held, at columns t = 0, 1, …
struct DirectTerm {
  const double* a;  ///< rows elements of every column
  const double* b;  ///< cols elements of every column; null: one that is 1
  size_t rows, cols;
  size_t first, stride;  ///< where it stands in θ: its first element, and elements from one of its columns to the next
};

/// One step of a sensitivity recursion, one component at a time: target = Σ_i factors[i] · S_i + scale · Σ a_t b_tᵀ, in
/// vectors of the widest kind that the machine has.
///
/// @param size         of θ.
/// @param sensitivity  S, size × n, column after column: S_i = ∂(carry component i)/∂θ.
/// @param factors      n derivatives of the component with respect to the carry.
/// @param terms        `count` of them, read at column `column`.
void PropagateSensitivity(size_t size, size_t n, const double* sensitivity, const double* factors, const DirectTerm* terms,
                          size_t count, size_t column, double scale, double* target);

}  // namespace metaekf::nssm
