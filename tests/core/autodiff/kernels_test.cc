#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <limits>
#include <memory>
#include <utility>
#include <vector>

#include "core/autodiff/kernel.h"
#include "core/base/rng.h"
#include "tests/support/instruction_sets.h"

namespace metaekf::autodiff {
namespace {

class KernelsTest : public support::InstructionSetTest {};

// Matrices lie in vectors of just their size, so that a sanitizer sees whoever reads or writes past them.
template <typename T>
std::vector<T> Random(int64_t size, base::Rng* rng) {
  std::vector<T> values(static_cast<size_t>(size));
  for (T& value : values) value = static_cast<T>(rng->Normal());
  return values;
}

template <typename T>
std::vector<T> RunKernel(const Instruction& i, Places<T> at, std::vector<T> out) {
  at.out = out.data();
  SelectKernel<T>(i)(i, at);
  return out;
}

/// op(A) op(B) and C + op(A) op(B) against sums one by one.
template <typename T>
void CheckSums(const Instruction& i, const std::vector<T>& a, const std::vector<T>& b, const std::vector<T>& c, const std::vector<T>& plain,
               const std::vector<T>& added) {
  for (int32_t col = 0; col < i.cols; ++col) {
    for (int32_t row = 0; row < i.rows; ++row) {
      double sum = 0, size_of_terms = 0;
      for (int32_t l = 0; l < i.inner; ++l) {
        const double term = static_cast<double>(a[static_cast<size_t>(i.transpose_a ? l + row * i.a.ld : row + l * i.a.ld)]) *
                            static_cast<double>(b[static_cast<size_t>(i.transpose_b ? col + l * i.b.ld : l + col * i.b.ld)]);
        sum += term;
        size_of_terms += std::fabs(term);
      }
      const size_t e = static_cast<size_t>(row + col * i.rows);
      const double addend = static_cast<double>(c[e]);
      const double tolerance = 4 * i.inner * std::numeric_limits<T>::epsilon() * (size_of_terms + std::fabs(addend));
      ASSERT_NEAR(plain[e], sum, tolerance) << i.rows << " × " << i.cols << " × " << i.inner;
      ASSERT_NEAR(added[e], sum + addend, tolerance) << i.rows << " × " << i.cols << " × " << i.inner;
    }
  }
}

/// With and without an addend, that of the result too.
template <typename T>
void CheckPanelProducts() {
  base::Rng rng(11);
  const auto size = [&rng](int32_t most) { return 1 + static_cast<int32_t>(rng.Index(static_cast<size_t>(most))); };
  for (int trial = 0; trial < 400; ++trial) {
    const int32_t m = size(trial % 2 == 0 ? 18 : 70), n = size(trial % 3 == 0 ? 4 : 1), k = size(20);
    Instruction i{.op = Opcode::kMatMul, .rows = m, .cols = n, .inner = k, .transpose_a = trial % 2 == 1, .panel = 0};
    i.a.ld = i.transpose_a ? k : m;
    i.b.ld = k;
    i.c.ld = i.out.ld = m;
    const std::vector<T> a = Random<T>(int64_t{m} * k, &rng), b = Random<T>(int64_t{k} * n, &rng), c = Random<T>(int64_t{m} * n, &rng);
    const std::unique_ptr<T, decltype(&std::free)> panel(
        static_cast<T*>(std::aligned_alloc(128, (static_cast<size_t>(PanelSize(m, k)) * sizeof(T) + 127) / 128 * 128)), &std::free);
    Places<T> at{.out = nullptr, .a = a.data(), .b = b.data(), .c = c.data(), .panel = panel.get()};
    MakePanel(i, at);
    const std::vector<T> plain = RunKernel(i, at, c);
    i.op = Opcode::kMatMulAdd;
    const std::vector<T> added = RunKernel(i, at, std::vector<T>(c.size()));
    std::vector<T> in_place = c;
    at.c = at.out = in_place.data();
    SelectKernel<T>(i)(i, at);
    EXPECT_EQ(added, in_place);
    CheckSums(i, a, b, c, plain, added);
  }
}

TEST_P(KernelsTest, PanelProductsInFloat) { CheckPanelProducts<float>(); }
TEST_P(KernelsTest, PanelProductsInDouble) { CheckPanelProducts<double>(); }

/// Products with few elements, of either factor transposed or not, with gaps between columns.
template <typename T>
void CheckSmallProducts() {
  base::Rng rng(14);
  const auto size = [&rng](int32_t most) { return 1 + static_cast<int32_t>(rng.Index(static_cast<size_t>(most))); };
  for (int trial = 0; trial < 600; ++trial) {
    const int32_t m = size(trial % 7 == 0 ? 40 : 18), n = size(3), k = size(trial % 2 == 0 ? 5 : 20), gap = trial % 3;
    Instruction i{.op = Opcode::kMatMul, .rows = m, .cols = n, .inner = k, .transpose_a = trial % 4 != 0, .transpose_b = trial % 5 == 0};
    i.a.ld = (i.transpose_a ? k : m) + gap;
    i.b.ld = (i.transpose_b ? n : k) + gap;
    i.c.ld = i.out.ld = m;
    const auto elements = [gap](int32_t ld, int32_t columns) { return int64_t{ld} * columns - gap; };
    const std::vector<T> a = Random<T>(elements(i.a.ld, i.transpose_a ? m : k), &rng), b = Random<T>(elements(i.b.ld, i.transpose_b ? k : n), &rng),
                         c = Random<T>(int64_t{m} * n, &rng);
    const Places<T> at{.out = nullptr, .a = a.data(), .b = b.data(), .c = c.data(), .panel = nullptr};
    const std::vector<T> plain = RunKernel(i, at, c);
    i.op = Opcode::kMatMulAdd;
    const std::vector<T> added = RunKernel(i, at, std::vector<T>(c.size()));
    CheckSums(i, a, b, c, plain, added);
  }
}

TEST_P(KernelsTest, SmallProductsInFloat) { CheckSmallProducts<float>(); }
TEST_P(KernelsTest, SmallProductsInDouble) { CheckSmallProducts<double>(); }

/// Rows that lie one behind the other are read in whole vectors, others not.
template <typename T>
void CheckTallProducts() {
  base::Rng rng(16);
  for (int32_t m = 1; m < 50; ++m) {
    for (int32_t k = 2; k <= 4; ++k) {
      const std::vector<T> a = Random<T>(int64_t{m} * k, &rng), b = Random<T>(k, &rng), c = Random<T>(m, &rng);
      std::vector<T> apart(static_cast<size_t>(m) * static_cast<size_t>(k + 1));
      for (size_t row = 0; row < static_cast<size_t>(m); ++row) {
        std::copy_n(a.begin() + static_cast<ptrdiff_t>(row) * k, k, apart.begin() + static_cast<ptrdiff_t>(row) * (k + 1));
      }
      Instruction i{.op = Opcode::kMatMulAdd, .rows = m, .cols = 1, .inner = k, .transpose_a = true};
      i.b.ld = k, i.c.ld = i.out.ld = m;
      i.a.ld = k;
      const std::vector<T> together = RunKernel(i, {.out = nullptr, .a = a.data(), .b = b.data(), .c = c.data(), .panel = nullptr}, c);
      i.a.ld = k + 1;
      EXPECT_EQ(together, RunKernel(i, {.out = nullptr, .a = apart.data(), .b = b.data(), .c = c.data(), .panel = nullptr}, c)) << m << " × " << k;
    }
  }
}

TEST_P(KernelsTest, TallProductsToTheBitInFloat) { CheckTallProducts<float>(); }
TEST_P(KernelsTest, TallProductsToTheBitInDouble) { CheckTallProducts<double>(); }

/// Each element is one operation: equal to the last bit, whatever the size.
template <typename T>
void CheckElementwise() {
  base::Rng rng(12);
  for (int32_t count = 1; count < 70; ++count) {
    const std::vector<T> a = Random<T>(count, &rng), b = Random<T>(count, &rng), none(static_cast<size_t>(count));
    const Places<T> at{.out = nullptr, .a = a.data(), .b = b.data(), .c = nullptr, .panel = nullptr};
    const auto run = [&](Opcode op) { return RunKernel({.op = op, .rows = count, .cols = 1, .scalar = 0.3}, at, none); };
    const std::vector<T> sum = run(Opcode::kAdd), difference = run(Opcode::kSub), product = run(Opcode::kMul), scaled = run(Opcode::kScale),
                         scaled_by = run(Opcode::kScaleBy);
    for (size_t k = 0; k < a.size(); ++k) {
      ASSERT_EQ(sum[k], a[k] + b[k]);
      ASSERT_EQ(difference[k], a[k] - b[k]);
      ASSERT_EQ(product[k], a[k] * b[k]);
      ASSERT_EQ(scaled[k], T(0.3) * a[k]);
      ASSERT_EQ(scaled_by[k], a[0] * b[k]);
    }
  }
}

/// The same where blocks of one operand are read again and again.
template <typename T>
void CheckTiled() {
  base::Rng rng(17);
  for (int trial = 0; trial < 200; ++trial) {
    const auto size = [&rng](size_t most) { return 1 + static_cast<int32_t>(rng.Index(most)); };
    const int32_t rows = size(40), width = size(3), count = size(4), blocks = size(3), cols = width * count * blocks;
    const std::vector<T> whole = Random<T>(int64_t{rows} * cols, &rng), tiles = Random<T>(int64_t{rows} * width * blocks, &rng);
    std::vector<T> repeated;
    for (int32_t block = 0; block < blocks; ++block) {
      for (int32_t repeat = 0; repeat < count; ++repeat) {
        const auto begin = tiles.begin() + int64_t{block} * rows * width;
        repeated.insert(repeated.end(), begin, begin + int64_t{rows} * width);
      }
    }
    const std::vector<T> none(whole.size());
    for (const Opcode op : {Opcode::kAdd, Opcode::kSub, Opcode::kMul}) {
      Instruction i{.op = op, .rows = rows, .cols = cols};
      const auto run = [&](const std::vector<T>& a, const std::vector<T>& b) {
        return RunKernel(i, {.out = nullptr, .a = a.data(), .b = b.data(), .c = nullptr, .panel = nullptr}, none);
      };
      const std::vector<T> first = run(repeated, whole), second = run(whole, repeated);
      i.a.tile_width = width, i.a.tile_count = count;
      ASSERT_EQ(run(tiles, whole), first);
      std::swap(i.a, i.b);
      ASSERT_EQ(run(whole, tiles), second);
    }
  }
}

TEST_P(KernelsTest, TiledInFloat) { CheckTiled<float>(); }
TEST_P(KernelsTest, TiledInDouble) { CheckTiled<double>(); }

TEST_P(KernelsTest, ElementwiseInFloat) { CheckElementwise<float>(); }
TEST_P(KernelsTest, ElementwiseInDouble) { CheckElementwise<double>(); }

/// In programs swish takes its sigmoid from another instruction; what comes is the same to the last bit.
TEST_P(KernelsTest, SwishFromItsSigmoid) {
  base::Rng rng(15);
  for (int32_t count = 1; count < 40; ++count) {
    const std::vector<float> z = Random<float>(count, &rng);
    std::vector<float> sigmoid(z.size()), expected(z.size());
    ApplyActivation(Activation::kSigmoid, 0, 0.0f, z.data(), sigmoid.data(), z.size());
    const Places<float> at{.out = nullptr, .a = z.data(), .b = sigmoid.data(), .c = nullptr, .panel = nullptr};
    for (int32_t order = 0; order <= kMaxDerivative; ++order) {
      ApplyActivation(Activation::kSwish, order, 0.0f, z.data(), expected.data(), z.size());
      EXPECT_EQ(RunKernel({.op = Opcode::kActivation, .rows = count, .cols = 1, .activation = Activation::kSwish, .order = order}, at,
                          std::vector<float>(z.size())),
                expected);
    }
  }
}

TEST(KernelsWithoutVectorsTest, SumsOfTilesOfAnySize) {
  base::Rng rng(13);
  for (int trial = 0; trial < 200; ++trial) {
    const auto size = [&rng](size_t most) { return 1 + static_cast<int32_t>(rng.Index(most)); };
    const int32_t rows = size(trial % 2 == 0 ? 3 : 80), width = size(3), count = size(300), blocks = size(3);
    const int64_t stretch = int64_t{rows} * width;
    const std::vector<double> a = Random<double>(stretch * count * blocks, &rng);
    const Places<double> at{.out = nullptr, .a = a.data(), .b = nullptr, .c = nullptr, .panel = nullptr};
    const std::vector<double> sums = RunKernel({.op = Opcode::kSumTiles, .rows = rows, .cols = width * count * blocks, .width = width, .count = count},
                                         at, std::vector<double>(static_cast<size_t>(stretch * blocks)));
    for (size_t e = 0; e < sums.size(); ++e) {
      const size_t block = e / static_cast<size_t>(stretch), place = e % static_cast<size_t>(stretch);
      double sum = 0;
      for (int32_t tile = 0; tile < count; ++tile) sum += a[(block * static_cast<size_t>(count) + static_cast<size_t>(tile)) * static_cast<size_t>(stretch) + place];
      ASSERT_NEAR(sums[e], sum, 1e-12 * count);
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Targets, KernelsTest, support::InstructionSets(), support::NameOfInstructionSet);

}  // namespace
}  // namespace metaekf::autodiff
