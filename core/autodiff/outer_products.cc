#include "core/autodiff/outer_products.h"

#include <cassert>

namespace metaekf::autodiff {
namespace {

class Collector {
 public:
  Collector(Graph* graph, int32_t columns) : graph_(*graph), columns_(columns) {}

  /// Adds scale · v, standing at rows `first` …
  void Add(Value v, double scale, int32_t first) {
    const Node node = graph_.node(v);
    switch (node.op) {
      case Op::kAdd:
        Add(node.inputs[0], scale, first);
        Add(node.inputs[1], scale, first);
        return;
      case Op::kScale:
        return Add(node.inputs[0], scale * node.scalar, first);
      case Op::kPadRows:
        return Add(node.inputs[0], scale, first + node.first);
      case Op::kMatMul:  // Σ_t a_t b_tᵀ
        assert(!node.transpose_a && node.transpose_b);
        found_.push_back({graph_.Scale(node.inputs[0], scale), node.inputs[1], first});
        return;
      case Op::kSumTiles:
        assert(node.cols == 1);
        found_.push_back({graph_.Scale(node.inputs[0], scale), kNoValue, first});
        return;
      default:
        if (graph_.IsConstant(v, 0)) return;
        // A single column is its own only summand.
        assert(columns_ == 1 && node.cols == 1);
        found_.push_back({graph_.Scale(v, scale), kNoValue, first});
    }
  }

  std::vector<OuterProduct> Take() { return std::move(found_); }

 private:
  Graph& graph_;
  const int32_t columns_;
  std::vector<OuterProduct> found_;
};

}  // namespace

std::vector<OuterProduct> OuterProducts(Graph* graph, Value cotangent, int32_t columns) {
  Collector collector(graph, columns);
  collector.Add(cotangent, 1, 0);
  return collector.Take();
}

}  // namespace metaekf::autodiff
