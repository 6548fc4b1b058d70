#include "core/autodiff/keep.h"

#include "core/autodiff/arena_allocator.h"

namespace metaekf::autodiff {
namespace {

constexpr int32_t kLeastTerms = 4;  // of the sums of a product that is dear

int64_t AlignedSize(const Node& node) { return Aligned(int64_t{node.rows} * node.cols); }

class Keeper {
 public:
  Keeper(const Graph& graph, const std::vector<Output>& earlier)
      : graph_(graph), computed_(static_cast<size_t>(graph.size()), false), seen_(computed_.size(), false) {
    for (const Output& output : earlier) computed_[static_cast<size_t>(output.value)] = true;
    for (Value v = graph.size() - 1; v >= 0; --v) {
      if (!computed_[static_cast<size_t>(v)]) continue;
      for (const Value input : graph.node(v).inputs) computed_[static_cast<size_t>(input)] = true;
    }
  }

  /// Looks for what is dear among the values that `v` is computed from, from `v` on.
  void Search(Value v) {
    if (seen_[static_cast<size_t>(v)]) return;
    seen_[static_cast<size_t>(v)] = true;
    if (IsComputed(v) && IsDear(v)) {
      kept_.push_back(v);
      return;
    }
    for (const Value input : graph_.node(v).inputs) Search(input);
  }

  const std::vector<Value>& kept() const { return kept_; }

 private:
  /// Whatever a recurrence has gone through it can hand out.
  bool IsComputed(Value v) const {
    const Node& node = graph_.node(v);
    return computed_[static_cast<size_t>(node.op == Op::kCollect ? node.inputs[0] : v)];
  }

  /// A sum is, if one of its terms is: products are added up in place.
  bool IsDear(Value v) const {
    const Node& node = graph_.node(v);
    if (node.op == Op::kAdd || node.op == Op::kSub) return IsDear(node.inputs[0]) || IsDear(node.inputs[1]);
    if (node.op == Op::kMatMul) {
      const Node& factor = graph_.node(node.inputs[0]);
      return (node.transpose_a ? factor.rows : factor.cols) >= kLeastTerms;
    }
    return node.op == Op::kCollect || node.op == Op::kFinalCarry;
  }

  const Graph& graph_;
  std::vector<bool> computed_, seen_;
  std::vector<Value> kept_;
};

std::vector<Output> OneAfterTheOther(const Graph& graph, const std::vector<Value>& values, int32_t slot) {
  std::vector<Output> outputs;
  int64_t offset = 0;
  for (const Value v : values) {
    outputs.push_back({v, slot, offset});
    offset += AlignedSize(graph.node(v));
  }
  return outputs;
}

}  // namespace

std::vector<Output> ValuesToKeep(const Graph& graph, const std::vector<Output>& earlier, const std::vector<Output>& later, int32_t slot) {
  Keeper keeper(graph, earlier);
  for (const Output& output : later) keeper.Search(output.value);
  return OneAfterTheOther(graph, keeper.kept(), slot);
}

std::vector<Output> ValuesFromSlot(const Graph& graph, const std::vector<Output>& outputs, int32_t from, int32_t slot) {
  const auto size = static_cast<size_t>(graph.size());
  std::vector<bool> follows(size), has_product(size), wanted(size, false);
  for (Value v = 0; v < graph.size(); ++v) {
    const auto at = static_cast<size_t>(v);
    const Node& node = graph.node(v);
    const bool recurs = node.op == Op::kScan || node.op == Op::kCollect || node.op == Op::kFinalCarry;
    follows[at] = node.op == Op::kInput ? node.slot == from : !recurs;
    has_product[at] = node.op == Op::kMatMul;
    for (const Value input : node.inputs) {
      follows[at] = follows[at] && follows[static_cast<size_t>(input)];
      has_product[at] = has_product[at] || has_product[static_cast<size_t>(input)];
    }
  }
  for (const Output& output : outputs) wanted[static_cast<size_t>(output.value)] = true;
  std::vector<Value> last;
  for (Value v = graph.size() - 1; v >= 0; --v) {
    const auto at = static_cast<size_t>(v);
    if (!wanted[at]) continue;
    if (follows[at]) {
      if (has_product[at]) last.push_back(v);
      continue;
    }
    for (const Value input : graph.node(v).inputs) wanted[static_cast<size_t>(input)] = true;
  }
  return OneAfterTheOther(graph, last, slot);
}

int64_t SizeOfKept(const Graph& graph, const std::vector<Output>& kept) {
  return kept.empty() ? 0 : kept.back().offset + AlignedSize(graph.node(kept.back().value));
}

}  // namespace metaekf::autodiff
