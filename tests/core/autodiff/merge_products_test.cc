#include "core/autodiff/merge_products.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "core/autodiff/differentiate.h"
#include "core/autodiff/evaluate.h"
#include "core/base/rng.h"

namespace metaekf::autodiff {
namespace {

constexpr int32_t kWidth = 20;  // of square factors, which are large enough to be worth it

std::vector<double> Random(size_t size, uint64_t seed) {
  base::Rng rng(seed);
  std::vector<double> values(size);
  for (double& value : values) value = rng.Uniform(-0.5, 0.5);
  return values;
}

size_t Products(const Program& program) {
  return static_cast<size_t>(std::count_if(program.instructions.begin(), program.instructions.end(), [](const Instruction& i) {
    return i.op == Opcode::kMatMul || i.op == Opcode::kMatMulAdd;
  }));
}

/// What the graph's values are, side by side, by one program for all of them.
std::vector<double> Compute(const Graph& graph, const std::vector<Value>& values, const std::vector<double>& inputs, size_t* products) {
  std::vector<Output> outputs;
  int64_t at = 0;
  for (const Value value : values) {
    outputs.push_back({value, 1, at});
    at += int64_t{graph.node(value).rows} * graph.node(value).cols;
  }
  const Executable<double> executable(Compile(graph, outputs));
  *products = Products(executable.program());
  std::vector<double> results(static_cast<size_t>(at));
  Evaluate(executable, Slots<double>().Input(0, inputs.data()).Output(1, results.data()), Arena<double>({&executable}));
  return results;
}

/// The same, each by a program of its own.
std::vector<double> ComputeOneByOne(const Graph& graph, const std::vector<Value>& values, const std::vector<double>& inputs) {
  std::vector<double> results;
  for (const Value value : values) {
    size_t products;
    const std::vector<double> own = Compute(graph, {value}, inputs, &products);
    results.insert(results.end(), own.begin(), own.end());
  }
  return results;
}

/// Square matrices in slot 0, then columns.
struct Inputs {
  Graph graph;
  int64_t size = 0;
  Value Next(int32_t cols) {
    const Value value = graph.Input(0, size, kWidth, cols);
    size += int64_t{kWidth} * cols;
    return value;
  }
};

TEST(MergeProductsTest, ASampleAndItsTangentsPassALayerTogether) {
  Inputs in;
  Graph& g = in.graph;
  const Value w1 = in.Next(kWidth), w2 = in.Next(kWidth), b = in.Next(1), x = in.Next(1), v = in.Next(3);
  const Value hidden = g.Apply(Activation::kTanh, 0, 0, g.AddColumn(g.MatMul(w1, x, true), b));
  const Value y = g.MatMul(w2, hidden, true);
  const Value tangent = Jvp(&g, {{x, v}}, {y}, 3)[0];
  const std::vector<double> inputs = Random(static_cast<size_t>(in.size), 1);
  size_t products;
  const std::vector<double> results = Compute(g, {y, tangent}, inputs, &products);
  EXPECT_EQ(products, 2U);
  size_t alone;
  const std::vector<double> value = Compute(g, {y}, inputs, &alone);
  EXPECT_EQ(std::vector<double>(results.begin(), results.begin() + kWidth), value);
  const double h = 1e-6;
  for (int direction = 0; direction < 3; ++direction) {
    const auto moved = [&](double by) {
      std::vector<double> at = inputs;
      const size_t x_at = 2 * kWidth * kWidth + kWidth, v_at = x_at + kWidth * static_cast<size_t>(1 + direction);
      for (size_t i = 0; i < kWidth; ++i) at[x_at + i] += by * inputs[v_at + i];
      return Compute(g, {y}, at, &alone);
    };
    const std::vector<double> up = moved(h), down = moved(-h);
    for (size_t i = 0; i < kWidth; ++i) {
      EXPECT_NEAR(results[kWidth * static_cast<size_t>(1 + direction) + i], (up[i] - down[i]) / (2 * h), 1e-9);
    }
  }
}

TEST(MergeProductsTest, AProductOfAProductIsNotMergedWithIt) {
  Inputs in;
  const Value w = in.Next(kWidth), x = in.Next(1);
  const Value y = in.graph.MatMul(w, x), z = in.graph.MatMul(w, y);
  const std::vector<double> inputs = Random(static_cast<size_t>(in.size), 2);
  size_t products;
  EXPECT_EQ(Compute(in.graph, {y, z}, inputs, &products), ComputeOneByOne(in.graph, {y, z}, inputs));
  EXPECT_EQ(products, 2U);
}

// A a and A b could be one, and so could B c and B d; both cannot, for b waits for B c and d for A a.
TEST(MergeProductsTest, GroupsThatWouldWaitForEachOtherAreNotMade) {
  Inputs in;
  Graph& g = in.graph;
  const Value A = in.Next(kWidth), B = in.Next(kWidth), a = in.Next(1), c = in.Next(1);
  const Value Aa = g.MatMul(A, a), Bc = g.MatMul(B, c);
  const Value Ab = g.MatMul(A, g.Scale(Bc, 2)), Bd = g.MatMul(B, g.Scale(Aa, 3));
  const std::vector<double> inputs = Random(static_cast<size_t>(in.size), 3);
  size_t products;
  EXPECT_EQ(Compute(g, {Aa, Ab, Bc, Bd}, inputs, &products), ComputeOneByOne(g, {Aa, Ab, Bc, Bd}, inputs));
  EXPECT_EQ(products, 3U);
}

/// Graphs of products by three factors, either way round, sums and tangents of what there is so far.
TEST(MergeProductsTest, NothingThatIsComputedChanges) {
  for (uint64_t seed = 0; seed < 60; ++seed) {
    base::Rng rng(seed);
    Inputs in;
    Graph& g = in.graph;
    const std::vector<Value> factors = {in.Next(kWidth), in.Next(kWidth), in.Next(kWidth)};
    std::vector<Value> values = {in.Next(1), in.Next(1), in.Next(3)};
    for (int i = 0; i < 25; ++i) {
      const Value v = values[rng.Index(values.size())];
      const Value other = values[rng.Index(values.size())];
      const bool fits = g.node(v).cols == g.node(other).cols;
      switch (rng.Index(4)) {
        case 0:
          values.push_back(fits ? g.Add(v, other) : g.Scale(v, 0.5));
          break;
        case 1:
          values.push_back(fits ? g.Mul(v, g.Apply(Activation::kTanh, 0, 0, other)) : g.Scale(v, -0.5));
          break;
        default:
          values.push_back(g.MatMul(factors[rng.Index(3)], v, rng.Index(2) == 0));
      }
    }
    const std::vector<Value> wanted(values.end() - 6, values.end());
    const std::vector<double> inputs = Random(static_cast<size_t>(in.size), 100 + seed);
    size_t products;
    const std::vector<double> together = Compute(g, wanted, inputs, &products), alone = ComputeOneByOne(g, wanted, inputs);
    for (size_t i = 0; i < alone.size(); ++i) ASSERT_NEAR(together[i], alone[i], 1e-13 * (1 + std::fabs(alone[i]))) << seed;
  }
}

}  // namespace
}  // namespace metaekf::autodiff
