#include "core/autodiff/per_column.h"

#include <cassert>

namespace metaekf::autodiff {
namespace {

class Summands {
 public:
  Summands(Graph* graph, int32_t columns) : graph_(*graph), columns_(columns) {}

  /// The summands of `v` as rows first … of a matrix of `rows` rows.
  Value Of(Value v, int32_t first, int32_t rows) {
    const Node node = graph_.node(v);
    switch (node.op) {
      case Op::kAdd:
        return graph_.Add(Of(node.inputs[0], first, rows), Of(node.inputs[1], first, rows));
      case Op::kScale:
        return graph_.Scale(Of(node.inputs[0], first, rows), node.scalar);
      case Op::kPadRows:
        return Of(node.inputs[0], first + node.first, rows);
      case Op::kMatMul:  // Σ_t a_t b_tᵀ
        assert(!node.transpose_a && node.transpose_b);
        return ByDirection(graph_.KhatriRao(graph_.PadRows(node.inputs[0], first, rows), node.inputs[1]));
      case Op::kSumTiles:
        assert(node.cols == 1);
        return ByDirection(graph_.PadRows(node.inputs[0], first, rows));
      default:
        if (graph_.IsConstant(v, 0)) return graph_.Constant(0, rows * node.cols, columns_);
        // A single column is its own only summand.
        assert(columns_ == 1 && node.cols == 1);
        return graph_.PadRows(v, first, rows);
    }
  }

 private:
  Value ByDirection(Value v) { return graph_.SumTiles(v, columns_, graph_.node(v).cols / columns_); }

  Graph& graph_;
  const int32_t columns_;
};

}  // namespace

Value PerColumn(Graph* graph, Value cotangent, int32_t columns) {
  return Summands(graph, columns).Of(cotangent, 0, graph->node(cotangent).rows);
}

}  // namespace metaekf::autodiff
