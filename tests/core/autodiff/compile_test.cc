#include <gtest/gtest.h>

#include <cmath>
#include <utility>
#include <vector>

#include "core/autodiff/evaluate.h"
#include "core/autodiff/program.h"
#include "tests/core/autodiff/derivative_check.h"

namespace metaekf::autodiff {
namespace {

/// A random straight-line graph of n × n matrices, n a multiple of three; every value is an output, or only the last few.
Graph RandomGraph(base::Rng* rng, int nodes, int32_t n, std::vector<Value>* values) {
  Graph g;
  for (int i = 0; i < 3; ++i) values->push_back(g.Input(0, int64_t{n} * n * i, n, n));
  const auto pick = [&] { return (*values)[rng->Index(values->size())]; };
  for (int i = 0; i < nodes; ++i) {
    const Value a = pick(), b = pick();
    Value v = kNoValue;
    switch (rng->Index(8)) {
      case 0:
        v = g.MatMul(a, b, rng->Index(2) != 0, rng->Index(2) != 0);
        break;
      case 1:
        v = g.Add(a, g.MatMul(a, b));
        break;
      case 2:
        v = g.Mul(a, b);
        break;
      case 3:
        v = g.Sub(a, g.Scale(b, 0.5));
        break;
      case 4:
        v = g.Add(a, g.Tile(g.SumTiles(b, 1, 3), 1, 3));
        break;
      case 5:
        v = g.MatMul(g.SliceRows(a, 1, 2), g.SliceRows(b, 0, 2), true, false);
        break;
      case 6:
        v = g.ConcatRows({g.SliceRows(a, 2, 1), g.SliceRows(b, 0, n - 1)});
        break;
      default:
        v = g.Apply(Activation::kTanh, 0, 0, g.ScaleBy(g.Dot(a, b), a));
        break;
    }
    values->push_back(g.Apply(Activation::kTanh, 0, 0, v));
  }
  return g;
}

// Oracle: the same value compiled with every other value kept, so that no buffer is reused and nothing fused away. Of large matrices
// elementwise instructions run piece by piece.
TEST(CompileTest, ReusingBuffersChangesNoResult) {
  size_t chains = 0;
  for (uint64_t seed = 0; seed < 120; ++seed) {
    base::Rng rng(seed);
    std::vector<Value> values;
    const int32_t n = seed % 2 == 0 ? 3 : 36;
    const Graph g = RandomGraph(&rng, 25, n, &values);
    const size_t size = static_cast<size_t>(n * n);
    std::vector<double> inputs(3 * size);
    for (double& value : inputs) value = rng.Normal() / std::sqrt(n);
    const std::vector<double> all = EvaluateFlat(g, values, {inputs});
    const std::vector<double> last = EvaluateFlat(g, {values.back()}, {inputs});
    for (size_t i = 0; i < size; ++i) ASSERT_NEAR(last[i], all[all.size() - size + i], 1e-12) << "seed " << seed;
    chains += Executable<double>(Compile(g, {{values.back(), 1}})).chains().size();
  }
  EXPECT_GT(chains, 20U);
}

// Oracle: the same program with no product packed, which runs instruction by instruction.
TEST(CompileTest, PieceByPieceIsTheSameToTheBit) {
  for (const int32_t n : {33, 36, 48}) {
    Graph g;
    const Value x = g.Input(0, 0, n, n), y = g.Input(0, int64_t{n} * n, n, n);
    const Value wave = g.Apply(Activation::kTanh, 0, 0, x), slope = g.Apply(Activation::kSwish, 1, 0, y);
    const Value z = g.Add(g.Mul(wave, g.Mul(slope, y)), g.Sub(g.Scale(x, 0.3), wave));
    const Executable<float> executable(Compile(g, {{z, 1}}));
    ASSERT_FALSE(executable.chains().empty());
    const size_t size = static_cast<size_t>(n * n);
    base::Rng rng(static_cast<uint64_t>(n));
    std::vector<float> inputs(2 * size), pieces(size), whole(size);
    for (float& value : inputs) value = static_cast<float>(rng.Normal());
    const Arena<float> arena({&executable});
    const Packed<float> nothing(executable.steps().size(), nullptr);
    Evaluate(executable, Slots<float>().Input(0, inputs.data()).Output(1, pieces.data()), arena);
    Evaluate(executable, Slots<float>().Input(0, inputs.data()).Output(1, whole.data()), arena, &nothing);
    EXPECT_EQ(pieces, whole);
  }
}

// The second writes where the first reads on.
TEST(CompileTest, InstructionsThatWouldDisturbEachOtherRunOneAfterTheOther) {
  constexpr int32_t kSize = 3000;
  const auto scale = [](Operand out, Operand a) { return Instruction{.op = Opcode::kScale, .rows = kSize, .cols = 1, .scalar = 2, .out = out, .a = a}; };
  const auto at = [](int32_t slot, int64_t offset) { return Operand{.slot = slot, .offset = offset, .ld = kSize}; };
  for (const int64_t shift : {int64_t{0}, int64_t{100}, int64_t{kSize}}) {
    Program program{.arena_size = 2 * kSize};
    program.instructions = {{.op = Opcode::kFill, .rows = kSize, .cols = 1, .scalar = 1, .out = at(Operand::kArena, 0)},
                            scale(at(0, 0), at(Operand::kArena, 0)),
                            scale(at(Operand::kArena, shift), at(0, 0)),
                            scale(at(1, 0), at(Operand::kArena, shift))};
    const Executable<double> executable(std::move(program));
    EXPECT_FALSE(executable.chains().empty());
    std::vector<double> two(kSize), eight(kSize);
    Evaluate(executable, Slots<double>().Output(0, two.data()).Output(1, eight.data()), Arena<double>({&executable}));
    EXPECT_EQ(two, std::vector<double>(kSize, 2)) << shift;
    EXPECT_EQ(eight, std::vector<double>(kSize, 8)) << shift;
  }
}

TEST(CompileTest, ScratchDoesNotGrowWithTheLengthOfAChain) {
  const auto arena = [](int layers) {
    Graph g;
    Value x = g.Input(0, 0, 16, 16);
    const Value w = g.Input(1, 0, 16, 16);
    for (int i = 0; i < layers; ++i) x = g.Apply(Activation::kTanh, 0, 0, g.MatMul(w, x));
    return Compile(g, {{x, 2}}).arena_size;
  };
  EXPECT_EQ(arena(20), arena(200));
}

TEST(CompileTest, SumsOfProductsAreMadeWhereTheyAreWanted) {
  Graph g;
  const auto square = [&g](int32_t i) { return g.Input(0, 256 * i, 16, 16); };
  const Value sum = g.Add(g.MatMul(square(0), square(1)), g.MatMul(square(2), square(3)));
  const Program program = Compile(g, {{sum, 1}});
  EXPECT_EQ(program.arena_size, 0);
  EXPECT_EQ(program.instructions.size(), 2U);
}

// A derivative's graph begins with all that it is the derivative of: here as many activations as layers, each wanted once, at the end.
TEST(CompileTest, ValuesAreMadeShortlyBeforeTheyAreRead) {
  const auto arena = [](int layers) {
    Graph g;
    std::vector<Value> made;
    for (int i = 0; i < layers; ++i) made.push_back(g.Apply(Activation::kTanh, 0, 0, g.Input(0, 256 * i, 16, 16)));
    Value y = g.Input(1, 0, 16, 16);
    for (const Value v : made) y = g.Apply(Activation::kTanh, 0, 0, g.MatMul(v, y));
    return Compile(g, {{y, 2}}).arena_size;
  };
  EXPECT_EQ(arena(5), arena(50));
}

TEST(CompileTest, AnOutputMayBeAnInputAConstantOrWantedTwice) {
  Graph g;
  const Value x = g.Input(0, 0, 2, 1), c = g.Constant(3, 2, 1), y = g.Add(x, c);
  EXPECT_EQ(EvaluateFlat(g, {x, c, y, y}, {{1, 2}}), (std::vector<double>{1, 2, 3, 3, 4, 5, 4, 5}));
}

TEST(CompileTest, SumsAreFoldedIntoProducts) {
  Graph g;
  const Value w = g.Input(0, 0, 4, 4), x = g.Input(1, 0, 4, 8), b = g.Input(2, 0, 4, 1);
  const Program program = Compile(g, {{g.AddColumn(g.MatMul(w, x), b), 3}});
  ASSERT_EQ(program.instructions.size(), 1u);
  EXPECT_EQ(program.instructions[0].op, Opcode::kMatMulAdd);
  EXPECT_EQ(program.arena_size, 0);
}

}  // namespace
}  // namespace metaekf::autodiff
