#include "core/autodiff/kernels.h"

#include "core/linalg/blas.h"

namespace metaekf::autodiff {
namespace {

constexpr int64_t kSmallProduct = 4096;  // multiplications below which plain loops win

void LibraryMatMul(CBLAS_TRANSPOSE ta, CBLAS_TRANSPOSE tb, int m, int n, int k, const float* a, int lda, const float* b,
                   int ldb, float beta, float* c, int ldc) {
  cblas_sgemm(CblasColMajor, ta, tb, m, n, k, 1.0f, a, lda, b, ldb, beta, c, ldc);
}

void LibraryMatMul(CBLAS_TRANSPOSE ta, CBLAS_TRANSPOSE tb, int m, int n, int k, const double* a, int lda,
                   const double* b, int ldb, double beta, double* c, int ldc) {
  cblas_dgemm(CblasColMajor, ta, tb, m, n, k, 1.0, a, lda, b, ldb, beta, c, ldc);
}

template <typename T>
T DotProduct(int32_t n, const T* x, const T* y) {
  T sum = 0;
  for (int32_t i = 0; i < n; ++i) sum += x[i] * y[i];
  return sum;
}

template <typename T>
void SmallMatMul(bool transpose_a, bool transpose_b, int32_t m, int32_t n, int32_t k, const T* a, int32_t lda,
                 const T* b, int32_t ldb, T* c, int32_t ldc) {
  for (int32_t j = 0; j < n; ++j) {
    T* column = c + int64_t{j} * ldc;
    if (transpose_a && !transpose_b) {
      for (int32_t i = 0; i < m; ++i) column[i] += DotProduct(k, a + int64_t{i} * lda, b + int64_t{j} * ldb);
      continue;
    }
    for (int32_t l = 0; l < k; ++l) {
      const T factor = transpose_b ? b[j + int64_t{l} * ldb] : b[l + int64_t{j} * ldb];
      if (transpose_a) {
        for (int32_t i = 0; i < m; ++i) column[i] += a[l + int64_t{i} * lda] * factor;
      } else {
        const T* a_column = a + int64_t{l} * lda;
        for (int32_t i = 0; i < m; ++i) column[i] += a_column[i] * factor;
      }
    }
  }
}

}  // namespace

template <typename T>
void MatMul(bool transpose_a, bool transpose_b, int32_t m, int32_t n, int32_t k, const T* a, int32_t lda, const T* b,
            int32_t ldb, T* c, int32_t ldc, bool accumulate) {
  if (int64_t{m} * n * k >= kSmallProduct) {
    LibraryMatMul(transpose_a ? CblasTrans : CblasNoTrans, transpose_b ? CblasTrans : CblasNoTrans, m, n, k, a, lda, b,
                  ldb, accumulate ? T(1) : T(0), c, ldc);
    return;
  }
  if (!accumulate) {
    for (int32_t j = 0; j < n; ++j) {
      for (int32_t i = 0; i < m; ++i) c[i + int64_t{j} * ldc] = 0;
    }
  }
  SmallMatMul(transpose_a, transpose_b, m, n, k, a, lda, b, ldb, c, ldc);
}

template void MatMul(bool, bool, int32_t, int32_t, int32_t, const float*, int32_t, const float*, int32_t, float*,
                     int32_t, bool);
template void MatMul(bool, bool, int32_t, int32_t, int32_t, const double*, int32_t, const double*, int32_t, double*,
                     int32_t, bool);

}  // namespace metaekf::autodiff
