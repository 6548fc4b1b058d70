#pragma once

#include <vector>

#include "core/autodiff/graph.h"

namespace metaekf::autodiff {

/// A part Σ_t a_t b_tᵀ of a cotangent: rows `first` … of it.
struct OuterProduct {
  Value a = kNoValue;
  Value b = kNoValue;  ///< kNoValue: b_t = 1
  int32_t first = 0;
};

/// Undoes the sum over columns in the cotangent of a parameter.
///
/// A parameter that serves `columns` columns of data has the cotangent Σ_t W̄_t, and W̄_t is a sum of outer products, as few
/// as the places where the parameter is used. They are returned without being multiplied out: with cotangents of one output
/// component they are its Jacobian, for every column at once.
///
/// @param cotangent  from Vjp, of a value that is used by products, biases and slices only, in graphs where no operation
///                   mixes columns (values with k directions have k blocks of `columns`, and so have the factors).
std::vector<OuterProduct> OuterProducts(Graph* graph, Value cotangent, int32_t columns);

}  // namespace metaekf::autodiff
