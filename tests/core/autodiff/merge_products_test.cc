#include "core/autodiff/merge_products.h"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <algorithm>

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

/// The oracle: a value by its definition, for the operations of these tests.
Eigen::MatrixXd Define(const Graph& graph, Value value, const std::vector<double>& inputs) {
  const Node& node = graph.node(value);
  const auto operand = [&](size_t i) { return Define(graph, node.inputs[i], inputs); };
  switch (node.op) {
    case Op::kInput:
      return Eigen::Map<const Eigen::MatrixXd>(inputs.data() + node.offset, node.rows, node.cols);
    case Op::kMatMul:
      return node.transpose_a ? Eigen::MatrixXd(operand(0).transpose() * operand(1)) : Eigen::MatrixXd(operand(0) * operand(1));
    case Op::kAdd:
      return operand(0) + operand(1);
    case Op::kMul:
      return operand(0).cwiseProduct(operand(1));
    case Op::kScale:
      return node.scalar * operand(0);
    case Op::kActivation:
      return operand(0).array().tanh();
    default:
      ADD_FAILURE() << "an operation without a definition";
      return {};
  }
}

/// Whether results, side by side, are what the values are by their definitions.
void ExpectDefinitions(const Graph& graph, const std::vector<Value>& values, const std::vector<double>& inputs, const std::vector<double>& results) {
  size_t at = 0;
  for (const Value value : values) {
    const Eigen::MatrixXd expected = Define(graph, value, inputs);
    for (Eigen::Index i = 0; i < expected.size(); ++i, ++at) {
      ASSERT_NEAR(results[at], expected.data()[i], 1e-12 * (1 + expected.cwiseAbs().maxCoeff()));
    }
  }
  EXPECT_EQ(at, results.size());
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
  ExpectDefinitions(in.graph, {y, z}, inputs, Compute(in.graph, {y, z}, inputs, &products));
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
  ExpectDefinitions(g, {Aa, Ab, Bc, Bd}, inputs, Compute(g, {Aa, Ab, Bc, Bd}, inputs, &products));
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
    SCOPED_TRACE(seed);
    ExpectDefinitions(g, wanted, inputs, Compute(g, wanted, inputs, &products));
  }
}

}  // namespace
}  // namespace metaekf::autodiff
