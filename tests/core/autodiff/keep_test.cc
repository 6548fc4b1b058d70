#include "core/autodiff/keep.h"

#include <gtest/gtest.h>

#include "core/autodiff/differentiate.h"

namespace metaekf::autodiff {
namespace {

constexpr int32_t kWidth = 12, kSamples = 5;
enum Slot : int32_t { kWeights, kDirection, kSample, kOut, kRecord };

int64_t Multiplications(const Program& program) {
  int64_t sum = 0;
  for (const Instruction& i : program.instructions) {
    if (i.op == Opcode::kMatMul || i.op == Opcode::kMatMulAdd) sum += int64_t{i.rows} * i.cols * i.inner;
  }
  return sum;
}

/// ½ |tanh(W₃ tanh(W₂ tanh(W₁ x)))|², its gradient in all Ws, and the Hessian times a direction.
struct Net {
  Net() {
    Value h = graph.Input(kSample, 0, kWidth, kSamples);
    std::vector<Value> weights;
    std::vector<Seed> seeds;
    for (int32_t layer = 0; layer < 3; ++layer) {
      weights.push_back(graph.Input(kWeights, layer * kWidth * kWidth, kWidth, kWidth));
      seeds.push_back({weights.back(), graph.Input(kDirection, layer * kWidth * kWidth, kWidth, kWidth)});
      h = graph.Apply(Activation::kTanh, 0, 0, graph.MatMul(weights.back(), h));
    }
    const std::vector<Value> of_weights = Gradient(&graph, graph.Scale(graph.Dot(h, h), 0.5), weights);
    gradient = Side(of_weights);
    product = Side(Jvp(&graph, seeds, of_weights));
  }

  static std::vector<Output> Side(const std::vector<Value>& values) {
    std::vector<Output> outputs;
    for (const Value value : values) outputs.push_back({value, kOut, static_cast<int64_t>(outputs.size()) * kWidth * kWidth});
    return outputs;
  }

  Graph graph;
  std::vector<Output> gradient, product;
};

TEST(KeepTest, AProductAfterAGradientSavesTheGradientsOwnProducts) {
  Net net;
  const int64_t from_scratch = Multiplications(Compile(net.graph, net.product));
  const std::vector<Output> kept = ValuesToKeep(net.graph, net.gradient, net.product, kRecord);
  EXPECT_EQ(kept.size(), 5U);  // three layers' z, and what comes back to two of them
  for (const Output& output : kept) net.graph.TurnIntoInput(output.value, output.slot, output.offset);
  EXPECT_EQ(from_scratch - Multiplications(Compile(net.graph, net.product)), 5 * kWidth * kWidth * kSamples);
}

TEST(KeepTest, KeptValuesDoNotOverlap) {
  const Net net;
  const std::vector<Output> kept = ValuesToKeep(net.graph, net.gradient, net.product, kRecord);
  int64_t end = 0;
  for (const Output& output : kept) {
    EXPECT_EQ(output.slot, kRecord);
    EXPECT_GE(output.offset, end);
    end = output.offset + kWidth * kSamples;
  }
  EXPECT_GE(SizeOfKept(net.graph, kept), end);
}

TEST(KeepTest, WhatTheEarlierProgramDoesNotComputeIsNotKept) {
  const Net net;
  EXPECT_TRUE(ValuesToKeep(net.graph, {}, net.product, kRecord).empty());
  EXPECT_TRUE(ValuesToKeep(net.graph, net.gradient, {}, kRecord).empty());
  EXPECT_EQ(SizeOfKept(net.graph, {}), 0);
}

TEST(KeepTest, WhatFollowsFromTheWeightsAloneIsComputedOnce) {
  Graph graph;
  const Value x = graph.Input(kSample, 0, kWidth, 1);
  const Value first = graph.Input(kWeights, 0, kWidth, kWidth), second = graph.Input(kWeights, kWidth * kWidth, kWidth, kWidth);
  const Value bias = graph.Input(kWeights, 2 * kWidth * kWidth, kWidth, 1);
  std::vector<double> identity(kWidth * kWidth, 0);
  for (size_t i = 0; i < kWidth; ++i) identity[i * (kWidth + 1)] = 1;
  const Value z = graph.AddColumn(graph.MatMul(second, graph.MatMul(first, x)), bias);
  const Value y = graph.Apply(Activation::kTanh, 0, 0, z);
  const Value jacobian = Jvp(&graph, {{x, graph.ConstantData(identity, kWidth, kWidth)}}, {y}, kWidth)[0];
  const std::vector<Output> outputs = {{y, kOut}, {jacobian, kOut, kWidth}};
  const int64_t from_scratch = Multiplications(Compile(graph, outputs));
  const std::vector<Output> kept = ValuesFromSlot(graph, outputs, kWeights, kRecord);
  ASSERT_EQ(kept.size(), 1U);  // the second factor times the first, neither of the two nor the bias
  EXPECT_EQ(graph.node(kept[0].value).cols, kWidth);
  const int64_t once = Multiplications(Compile(graph, kept));
  EXPECT_EQ(once, 2 * kWidth * kWidth * kWidth);
  graph.TurnIntoInput(kept[0].value, kept[0].slot, kept[0].offset);
  EXPECT_EQ(from_scratch - Multiplications(Compile(graph, outputs)), once);
  EXPECT_TRUE(ValuesFromSlot(graph, {{y, kOut}}, kSample, kRecord).empty());
}

TEST(KeepTest, ProductsOfFewTermsAreComputedAgain) {
  Graph graph;
  const Value x = graph.MatMul(graph.Input(kWeights, 0, kWidth, 2), graph.Input(kSample, 0, 2, kSamples));
  EXPECT_TRUE(ValuesToKeep(graph, {{x, kOut}}, {{graph.Apply(Activation::kTanh, 0, 0, x), kOut}}, kRecord).empty());
}

}  // namespace
}  // namespace metaekf::autodiff
