#pragma once

#include "core/autodiff/graph.h"

namespace metaekf::autodiff {

/// Undoes the sum over columns in the cotangent of a parameter.
///
/// A parameter that serves `columns` columns of data has the cotangent Σ_t W̄_t. This returns the summands side by side:
/// column t holds the elements of W̄_t, column-major. With cotangents of one output component it is the Jacobian of
/// that component, for every column at once.
///
/// @param cotangent  from Vjp, of a value that is used by products, biases and slices only, in graphs where no operation
///                   mixes columns (values with k directions have k blocks of `columns`).
/// @return (rows · cols of the parameter) × columns.
Value PerColumn(Graph* graph, Value cotangent, int32_t columns);

}  // namespace metaekf::autodiff
