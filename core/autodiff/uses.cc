#include "core/autodiff/uses.h"

#include <algorithm>

namespace metaekf::autodiff {
namespace {

bool TilesBoth(const Graph& graph, const Node& node) {
  return graph.node(node.inputs[0]).op == Op::kTile && graph.node(node.inputs[1]).op == Op::kTile;
}

}  // namespace

Uses::Uses(const Graph& graph, const std::vector<bool>& needed, const std::vector<bool>& kept)
    : count(needed.size(), 0), last(needed.size(), -1), in_place(needed.size(), false), fused(needed.size(), false) {
  std::vector<bool> only_products(needed.size(), true), only_elementwise(needed.size(), true);
  for (Value v = 0; v < graph.size(); ++v) {
    const size_t i = static_cast<size_t>(v);
    if (!needed[i]) continue;
    const Node& node = graph.node(v);
    for (const Value input : node.inputs) {
      const size_t j = static_cast<size_t>(input);
      ++count[j];
      last[j] = std::max(last[j], v);
      only_products[j] = only_products[j] && node.op == Op::kMatMul;
      only_elementwise[j] = only_elementwise[j] && IsBinaryElementwise(node.op) &&
                            node.inputs[0] != node.inputs[1] && !TilesBoth(graph, node);
    }
  }
  for (Value v = 0; v < graph.size(); ++v) {
    const size_t i = static_cast<size_t>(v);
    if (!needed[i]) continue;
    const Node& node = graph.node(v);
    if (node.op == Op::kSliceRows) in_place[i] = only_products[i] && !kept[i];
    if (node.op == Op::kSliceCols) in_place[i] = !kept[i];
    if (node.op == Op::kTile) in_place[i] = only_elementwise[i] && !kept[i];
    if (node.op == Op::kCollect || node.op == Op::kFinalCarry) in_place[i] = true;
  }
  // Add(x, MatMul) becomes one instruction if nobody else wants the product.
  for (Value v = 0; v < graph.size(); ++v) {
    const size_t i = static_cast<size_t>(v);
    if (!needed[i] || graph.node(v).op != Op::kAdd) continue;
    const Value product = FusableProduct(graph, graph.node(v), kept);
    if (product != kNoValue) fused[static_cast<size_t>(product)] = true;
  }
}

Value Uses::FusableProduct(const Graph& graph, const Node& add, const std::vector<bool>& kept) const {
  for (const size_t which : {1, 0}) {
    const Value candidate = add.inputs[which];
    if (graph.node(candidate).op == Op::kMatMul && count[static_cast<size_t>(candidate)] == 1 &&
        !kept[static_cast<size_t>(candidate)] && add.inputs[0] != add.inputs[1]) {
      return candidate;
    }
  }
  return kNoValue;
}

}  // namespace metaekf::autodiff
