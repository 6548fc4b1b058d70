#include "core/linalg/products.h"

#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

#include "core/base/rng.h"
#include "tests/support/instruction_sets.h"

namespace metaekf::linalg {
namespace {

std::vector<double> Random(size_t size, base::Rng* rng) {
  std::vector<double> values(size);
  for (double& value : values) value = rng->Normal();
  return values;
}

class ProductsTest : public support::InstructionSetTest {};

struct Shape {
  int32_t m, n, k;
};

/// Sizes about those of tiles, vectors and the depth of panels, and any.
Shape RandomShape(base::Rng* rng) {
  const auto size = [rng](int32_t most) { return 1 + static_cast<int32_t>(rng->Uniform(0, 1) * most); };
  switch (size(5)) {
    case 1:
      return {size(130), size(5), size(600)};
    case 4:
      return {size(9), size(9), size(600)};
    case 2:
      return {size(9), size(130), size(70)};
    case 3:
      return {size(130), size(50), size(20)};
    default:
      return {size(20), size(20), size(20)};
  }
}

/// The matrices are as small as their shapes allow, so that a sanitizer sees whoever reads past them.
template <typename T>
void CheckRandomProducts() {
  base::Rng rng(7);
  for (int trial = 0; trial < 400; ++trial) {
    const auto [m, n, k] = RandomShape(&rng);
    const bool ta = rng.Uniform(0, 1) < 0.5, tb = rng.Uniform(0, 1) < 0.5, accumulate = rng.Uniform(0, 1) < 0.5;
    const int32_t gap = trial % 3;  // rows of the memory that are not the matrix's
    const int32_t lda = (ta ? k : m) + gap, ldb = (tb ? n : k) + gap, ldc = m + gap;
    const auto size = [gap](int32_t ld, int32_t columns) { return static_cast<size_t>(ld) * static_cast<size_t>(columns) - static_cast<size_t>(gap); };
    const std::vector<double> a = Random(size(lda, ta ? m : k), &rng), b = Random(size(ldb, tb ? k : n), &rng), c = Random(size(ldc, n), &rng);
    const std::vector<T> ta_values(a.begin(), a.end()), tb_values(b.begin(), b.end());
    std::vector<T> result(c.begin(), c.end());
    MatMul(ta, tb, m, n, k, ta_values.data(), lda, tb_values.data(), ldb, result.data(), ldc, accumulate);
    for (int32_t j = 0; j < n; ++j) {
      for (int32_t i = 0; i < ldc && i + j * ldc < static_cast<int32_t>(c.size()); ++i) {
        const auto at = static_cast<size_t>(i + j * ldc);
        if (i >= m) {
          ASSERT_EQ(result[at], static_cast<T>(c[at])) << "row " << i << " is not of the matrix";
          continue;
        }
        double sum = accumulate ? c[at] : 0, size_of_sum = std::abs(sum);
        for (int32_t l = 0; l < k; ++l) {
          const double term = a[static_cast<size_t>(ta ? l + i * lda : i + l * lda)] * b[static_cast<size_t>(tb ? j + l * ldb : l + j * ldb)];
          sum += term;
          size_of_sum += std::abs(term);
        }
        // Values are rounded to T, then each product and sum once more.
        ASSERT_NEAR(static_cast<double>(result[at]), sum, (k + 4) * std::numeric_limits<T>::epsilon() * size_of_sum)
            << m << " × " << n << " × " << k << ", transposed " << ta << tb << ", element " << i << ", " << j;
      }
    }
  }
}

TEST_P(ProductsTest, FloatsAreTheSumsOfTheirTerms) { CheckRandomProducts<float>(); }

TEST_P(ProductsTest, DoublesAreTheSumsOfTheirTerms) { CheckRandomProducts<double>(); }

TEST_P(ProductsTest, NoTermsAreZero) {
  std::vector<double> c = {1, 2, 3, 4};
  MatMul<double>(false, false, 2, 2, 0, nullptr, 2, nullptr, 1, c.data(), 2, true);
  EXPECT_EQ(c, (std::vector<double>{1, 2, 3, 4}));
  MatMul<double>(false, false, 2, 2, 0, nullptr, 2, nullptr, 1, c.data(), 2, false);
  EXPECT_EQ(c, std::vector<double>(4));
}

TEST_P(ProductsTest, ASquareIsTheProductWithTheTransposed) {
  base::Rng rng(3);
  for (const auto& [m, k] : {std::pair{1, 5}, {47, 300}, {48, 1}, {145, 33}}) {
    const std::vector<double> a = Random(static_cast<size_t>(m) * static_cast<size_t>(k), &rng);
    std::vector<double> square(static_cast<size_t>(m) * static_cast<size_t>(m), 1), product = square;
    AddSquare(m, k, a.data(), m, square.data(), m);
    MatMul(false, true, m, m, k, a.data(), m, a.data(), m, product.data(), m, true);
    for (int j = 0; j < m; ++j) {
      for (int i = j; i < m; ++i) {
        const auto at = static_cast<size_t>(i + j * m);
        ASSERT_NEAR(square[at], product[at], 1e-13 * k);
      }
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Targets, ProductsTest, support::InstructionSets(), support::NameOfInstructionSet);

}  // namespace
}  // namespace metaekf::linalg
