#pragma once

#include <span>
#include <string>
#include <vector>

#include "core/autodiff/graph.h"
#include "core/base/rng.h"
#include "core/nn/parameters.h"

namespace metaekf::nn {

/// The shape of a fully connected block; the message BlockSpec of spec.proto.
struct BlockSpec {
  std::vector<int32_t> hidden_widths;  ///< none: a single linear map
  autodiff::Activation activation = autodiff::Activation::kTanh;
  double activation_parameter = 0;  ///< slope of the leaky ReLU, α of the ELU, β of swish (0: 1)
  bool trained_beta = false;        ///< of swish: every hidden unit has a β of its own, which begins as activation_parameter
  bool bias = true;
  double output_scale = 1;  ///< factor on the last layer's initial weights

  double Beta() const { return activation_parameter > 0 ? activation_parameter : 1; }
};

/// z ← W_l z + b_l, with σ after every layer but the last.
///
/// Swish is σ(z) = z/(1 + e^{−βz}) = swish₁(βz)/β. Where β is trained, a unit is swish₁(βz)/β₀ with β₀ the one it begins with: the
/// rest of the factor is for the next layer's weights to find.
class Block {
 public:
  Block() = default;
  /// Appends the parameters `name`.0.weight, `name`.0.bias, … to the layout.
  Block(const std::string& name, const BlockSpec& spec, int32_t in, int32_t out, ParameterLayout* layout);

  /// @param x      in × b.
  /// @param shift  out × b, added to the result; before the last product, for which a recurrence waits.
  /// @return out × b.
  autodiff::Value Apply(autodiff::Graph* graph, const ParameterValues& parameters, autodiff::Value x,
                        autodiff::Value shift = autodiff::kNoValue) const;

  /// Apply([a; b]) without stacking: the first layer's weight meets its parts one by one, so that the part that
  /// does not depend on a recurrence can leave its loop.
  autodiff::Value ApplyStacked(autodiff::Graph* graph, const ParameterValues& parameters, autodiff::Value a,
                               autodiff::Value b, autodiff::Value shift = autodiff::kNoValue) const;

  /// Draws weights with standard deviation gain/√in (gain √2 after ReLU-like activations), biases zero; the last layer's
  /// weights are multiplied by output_scale, every β is what it begins with.
  void Initialise(const ParameterLayout& layout, base::Rng* rng, std::span<double> parameters) const;

 private:
  /// σ of hidden layer `layer`.
  autodiff::Value Activate(autodiff::Graph* graph, const ParameterValues& parameters, size_t layer, autodiff::Value z) const;
  /// From what the first layer's function is applied to.
  autodiff::Value ApplyFrom(autodiff::Graph* graph, const ParameterValues& parameters, autodiff::Value first, autodiff::Value shift) const;
  autodiff::Value AddBias(autodiff::Graph* graph, const ParameterValues& parameters, size_t layer,
                          autodiff::Value z) const;

  BlockSpec spec_;
  std::vector<size_t> weights_, biases_, betas_;  // indices of tensors, by layer
};

}  // namespace metaekf::nn
