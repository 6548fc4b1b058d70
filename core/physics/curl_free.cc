#include "core/physics/curl_free.h"

#include "core/autodiff/differentiate.h"

namespace metaekf::physics {

using autodiff::Graph;
using autodiff::Node;
using autodiff::Value;

Value CurlFree(Graph* graph, Value potential, Value state, const std::vector<int32_t>& positions) {
  const Node shape = graph->node(potential);
  // Columns do not mix, so one reverse pass with ones gives every column's own gradient.
  const Value gradient = autodiff::Vjp(graph, {{potential, graph->Constant(1, 1, shape.cols)}}, {state})[0];
  std::vector<Value> field;
  for (const int32_t position : positions) {
    field.push_back(gradient == autodiff::kNoValue ? graph->Constant(0, 1, shape.cols)
                                                   : graph->SliceRows(gradient, position, 1));
  }
  return graph->ConcatRows(field);
}

}  // namespace metaekf::physics
