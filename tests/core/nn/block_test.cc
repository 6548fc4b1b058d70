#include "core/nn/block.h"

#include <gtest/gtest.h>

#include <cmath>

#include "core/autodiff/evaluate.h"

namespace metaekf::nn {
namespace {

using autodiff::Activation;

constexpr double kPoints[] = {-3, -0.4, 0, 0.7, 2};

/// Values of a block with one hidden unit, whose weights are 1 and whose biases are 0, with `beta` where one is trained.
std::vector<double> HiddenUnit(const BlockSpec& spec, double beta) {
  ParameterLayout layout;
  const Block block("b", spec, 1, 1, &layout);
  std::vector<double> parameters(static_cast<size_t>(layout.size()), 0);
  for (const Tensor& tensor : layout.tensors()) {
    if (tensor.name == "b.0.beta") parameters[static_cast<size_t>(tensor.offset)] = beta;
    if (!tensor.is_bias) parameters[static_cast<size_t>(tensor.offset)] = 1;
  }
  autodiff::Graph graph;
  const ParameterValues bound = BindParameters(layout, 0, &graph);
  const int32_t count = static_cast<int32_t>(std::size(kPoints));
  const autodiff::Value value = block.Apply(&graph, bound, graph.Input(1, 0, 1, count));
  const autodiff::Executable<double> program(autodiff::Compile(graph, {{value, 2}}));
  autodiff::Arena<double> arena({&program});
  std::vector<double> values(std::size(kPoints));
  autodiff::Slots<double> slots;
  slots.Input(0, parameters.data()).Input(1, kPoints).Output(2, values.data());
  autodiff::Evaluate(program, slots, arena);
  return values;
}

double Swish(double z, double beta) { return z / (1 + std::exp(-beta * z)); }

TEST(BlockTest, SwishHasItsBeta) {
  for (const double beta : {1.0, 0.3, 4.0}) {
    const std::vector<double> values = HiddenUnit({.hidden_widths = {1}, .activation = Activation::kSwish, .activation_parameter = beta}, 0);
    for (size_t i = 0; i < values.size(); ++i) EXPECT_NEAR(values[i], Swish(kPoints[i], beta), 1e-14);
  }
}

TEST(BlockTest, WithoutABetaItIsOne) {
  EXPECT_EQ(HiddenUnit({.hidden_widths = {1}, .activation = Activation::kSwish}, 0),
            HiddenUnit({.hidden_widths = {1}, .activation = Activation::kSwish, .activation_parameter = 1}, 0));
}

TEST(BlockTest, ATrainedBetaGoesOnFromTheFixedOne) {
  const BlockSpec spec{.hidden_widths = {1}, .activation = Activation::kSwish, .activation_parameter = 0.3, .trained_beta = true};
  const std::vector<double> first = HiddenUnit(spec, 0.3), later = HiddenUnit(spec, 2);
  for (size_t i = 0; i < first.size(); ++i) {
    EXPECT_NEAR(first[i], Swish(kPoints[i], 0.3), 1e-14);
    EXPECT_NEAR(later[i], 2 / 0.3 * Swish(kPoints[i], 2), 1e-14);
  }
}

TEST(BlockTest, EveryHiddenUnitHasABetaThatBeginsAsItIsSaid) {
  ParameterLayout layout;
  const BlockSpec spec{.hidden_widths = {3, 2}, .activation = Activation::kSwish, .activation_parameter = 0.3, .trained_beta = true};
  const Block block("b", spec, 2, 1, &layout);
  std::vector<double> parameters(static_cast<size_t>(layout.size()));
  base::Rng rng(1);
  block.Initialise(layout, &rng, parameters);
  int betas = 0;
  for (const Tensor& tensor : layout.tensors()) {
    if (tensor.name != "b.0.beta" && tensor.name != "b.1.beta") continue;
    for (int64_t i = 0; i < tensor.size(); ++i, ++betas) EXPECT_EQ(parameters[static_cast<size_t>(tensor.offset + i)], 0.3);
  }
  EXPECT_EQ(betas, 3 + 2);
  EXPECT_EQ(layout.size(), (2 * 3 + 3 + 3) + (3 * 2 + 2 + 2) + (2 + 1));
}

}  // namespace
}  // namespace metaekf::nn
