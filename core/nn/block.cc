#include "core/nn/block.h"

#include <cmath>

#include "absl/strings/str_cat.h"

namespace metaekf::nn {

using autodiff::Activation;
using autodiff::Graph;
using autodiff::Value;

Block::Block(const std::string& name, const BlockSpec& spec, int32_t in, int32_t out, ParameterLayout* layout)
    : spec_(spec) {
  std::vector<int32_t> widths = spec.hidden_widths;
  widths.push_back(out);
  for (size_t layer = 0; layer < widths.size(); ++layer) {
    weights_.push_back(layout->Add(absl::StrCat(name, ".", layer, ".weight"), widths[layer], in));
    if (spec.bias) biases_.push_back(layout->Add(absl::StrCat(name, ".", layer, ".bias"), widths[layer], 1, true));
    if (spec.trained_beta && layer + 1 < widths.size()) betas_.push_back(layout->Add(absl::StrCat(name, ".", layer, ".beta"), widths[layer], 1, true));
    in = widths[layer];
  }
}

Value Block::AddBias(Graph* graph, const ParameterValues& parameters, size_t layer, Value z) const {
  return spec_.bias ? graph->AddColumn(z, parameters[biases_[layer]]) : z;
}

Value Block::Activate(Graph* graph, const ParameterValues& parameters, size_t layer, Value z) const {
  const double beta = spec_.Beta();
  if (spec_.activation != Activation::kSwish || (beta == 1 && !spec_.trained_beta)) {
    return graph->Apply(spec_.activation, spec_.activation_parameter, 0, z);
  }
  const Value scaled = spec_.trained_beta ? graph->Mul(graph->Tile(parameters[betas_[layer]], 1, graph->node(z).cols), z) : graph->Scale(z, beta);
  return graph->Scale(graph->Apply(Activation::kSwish, 1, 0, scaled), 1 / beta);
}

Value Block::ApplyFrom(Graph* graph, const ParameterValues& parameters, Value z, Value shift) const {
  for (size_t layer = 1; layer < weights_.size(); ++layer) {
    z = Activate(graph, parameters, layer - 1, z);
    const Value product = graph->MatMul(parameters[weights_[layer]], z, true);
    if (layer + 1 < weights_.size() || shift == autodiff::kNoValue) {
      z = AddBias(graph, parameters, layer, product);
    } else {
      return graph->Add(product, AddBias(graph, parameters, layer, shift));
    }
  }
  return graph->AddOrEither(z, shift);
}

Value Block::Apply(Graph* graph, const ParameterValues& parameters, Value x, Value shift) const {
  const Value first = graph->MatMul(parameters[weights_[0]], x, true);
  return ApplyFrom(graph, parameters, AddBias(graph, parameters, 0, first), shift);
}

Value Block::ApplyStacked(Graph* graph, const ParameterValues& parameters, Value a, Value b, Value shift) const {
  const Value weight = parameters[weights_[0]];
  const int32_t a_rows = graph->node(a).rows, b_rows = graph->node(b).rows;
  const Value from_b = graph->MatMul(graph->SliceRows(weight, a_rows, b_rows), b, true);
  const Value from_a = graph->MatMul(graph->SliceRows(weight, 0, a_rows), a, true);
  return ApplyFrom(graph, parameters, graph->Add(AddBias(graph, parameters, 0, from_b), from_a), shift);
}

void Block::Initialise(const ParameterLayout& layout, base::Rng* rng, std::span<double> parameters) const {
  const bool half_dead = spec_.activation == Activation::kRelu || spec_.activation == Activation::kLeakyRelu;
  for (size_t layer = 0; layer < weights_.size(); ++layer) {
    const Tensor& tensor = layout.tensors()[weights_[layer]];
    const bool last = layer + 1 == weights_.size();
    const double gain = last ? spec_.output_scale : half_dead ? std::sqrt(2.0) : 1.0;
    const double deviation = gain / std::sqrt(static_cast<double>(tensor.in));
    for (int64_t i = 0; i < tensor.size(); ++i) {
      parameters[static_cast<size_t>(tensor.offset + i)] = deviation * rng->Normal();
    }
  }
  for (const size_t bias : biases_) {
    const Tensor& tensor = layout.tensors()[bias];
    std::fill_n(parameters.begin() + tensor.offset, tensor.size(), 0.0);
  }
  for (const size_t beta : betas_) {
    const Tensor& tensor = layout.tensors()[beta];
    std::fill_n(parameters.begin() + tensor.offset, tensor.size(), spec_.Beta());
  }
}

}  // namespace metaekf::nn
