#include "core/linalg/packed_product.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <memory>
#include <new>
#include <vector>

#include "core/base/rng.h"
#include "tests/support/instruction_sets.h"

namespace metaekf::linalg {
namespace {

class PackedProductTest : public support::InstructionSetTest {};

template <typename T>
std::vector<T> Random(int64_t size, base::Rng* rng) {
  std::vector<T> values(static_cast<size_t>(size));
  for (T& value : values) value = static_cast<T>(rng->Normal());
  return values;
}

/// A matrix as PackedMatMul reads it: aligned, and as large as it says, so that a sanitizer sees whoever reads past it.
template <typename T>
class PackedMatrix {
 public:
  PackedMatrix(bool transpose, int32_t rows, int32_t columns, const std::vector<T>& a, int32_t lda)
      : memory_(static_cast<T*>(::operator new[](sizeof(T) * static_cast<size_t>(PackedSize(rows, columns)), std::align_val_t(128)))) {
    Pack(transpose, rows, columns, a.data(), lda, memory_.get());
  }
  const T* data() const { return memory_.get(); }

 private:
  struct Free {
    void operator()(T* memory) const { ::operator delete[](memory, std::align_val_t(128)); }
  };
  std::unique_ptr<T[], Free> memory_;
};

template <typename T>
void CheckSumsAndThatColumnsDoNotMatter() {
  base::Rng rng(5);
  const auto size = [&rng](int32_t most) { return 1 + static_cast<int32_t>(rng.Index(static_cast<size_t>(most))); };
  for (int trial = 0; trial < 200; ++trial) {
    const int32_t m = size(trial % 2 == 0 ? 150 : 20), k = size(trial % 3 == 0 ? 300 : 20), n = size(34), gap = trial % 3;
    const bool transpose = rng.Uniform(0, 1) < 0.5, turned = rng.Uniform(0, 1) < 0.5, accumulate = rng.Uniform(0, 1) < 0.5;
    const int32_t lda = (transpose ? k : m) + gap, ldb = k + gap, ldc = m + gap;
    const std::vector<T> a = Random<T>(int64_t{lda} * (transpose ? m : k), &rng), b = Random<T>(int64_t{ldb} * n - gap, &rng),
                         before = Random<T>(int64_t{ldc} * n - gap, &rng);
    const PackedMatrix<T> packed(transpose != turned, turned ? k : m, turned ? m : k, a, lda);
    std::vector<T> c = before;
    PackedMatMul(turned, m, n, k, packed.data(), b.data(), ldb, c.data(), ldc, accumulate);
    for (int32_t j = 0; j < n; ++j) {
      std::vector<T> alone(before.begin() + j * ldc, before.begin() + j * ldc + m);
      PackedMatMul(turned, m, 1, k, packed.data(), b.data() + j * ldb, ldb, alone.data(), m, accumulate);
      for (int32_t i = 0; i < m; ++i) {
        const auto at = static_cast<size_t>(i + j * ldc);
        double sum = accumulate ? static_cast<double>(before[at]) : 0, terms = std::fabs(sum);
        for (int32_t l = 0; l < k; ++l) {
          const double term = static_cast<double>(a[static_cast<size_t>(transpose ? l + i * lda : i + l * lda)]) *
                              static_cast<double>(b[static_cast<size_t>(l + j * ldb)]);
          sum += term;
          terms += std::fabs(term);
        }
        ASSERT_NEAR(static_cast<double>(c[at]), sum, (k + 4) * std::numeric_limits<T>::epsilon() * terms) << m << " × " << n << " × " << k;
        ASSERT_EQ(c[at], alone[static_cast<size_t>(i)]) << "column " << j << " of " << n << " depends on the others";
      }
      for (int32_t i = m; i < ldc && j + 1 < n; ++i) {
        ASSERT_EQ(c[static_cast<size_t>(i + j * ldc)], before[static_cast<size_t>(i + j * ldc)]) << "row " << i << " is not of the matrix";
      }
    }
  }
}

TEST_P(PackedProductTest, FloatsAreTheSumsOfTheirTermsHoweverManyColumnsThereAre) { CheckSumsAndThatColumnsDoNotMatter<float>(); }

TEST_P(PackedProductTest, DoublesAreTheSumsOfTheirTermsHoweverManyColumnsThereAre) { CheckSumsAndThatColumnsDoNotMatter<double>(); }

INSTANTIATE_TEST_SUITE_P(Targets, PackedProductTest, support::InstructionSets(), support::NameOfInstructionSet);

}  // namespace
}  // namespace metaekf::linalg
