#pragma once

#include <cstdint>
#include <vector>

#include "core/autodiff/graph.h"

namespace metaekf::autodiff {

inline bool IsBinaryElementwise(Op op) { return op == Op::kAdd || op == Op::kSub || op == Op::kMul; }

/// Readers of each value among the needed nodes of one graph, and what the readers allow: slices are read in
/// place by products, tiles by elementwise operations.
struct Uses {
  Uses(const Graph& graph, const std::vector<bool>& needed, const std::vector<bool>& kept);

  /// The operand of an addition that can be accumulated onto the other one; kNoValue if there is none.
  Value FusableProduct(const Graph& graph, const Node& add, const std::vector<bool>& kept) const;

  std::vector<int32_t> count;
  std::vector<Value> last;     // the last reader
  std::vector<bool> in_place;  // a view: no instruction of its own
  std::vector<bool> fused;     // a product computed by the addition that reads it
};

}  // namespace metaekf::autodiff
