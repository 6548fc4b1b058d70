#pragma once

#include <cstdint>

namespace metaekf::linalg {

/// C ← op(A) op(B), or C += op(A) op(B) if `accumulate`; op(A) is m × k, op(B) k × n, all column-major and of no
/// overlap. T is float or double.
///
/// Our own rather than a library's: OpenBLAS 0.3.21 takes processors that came after it for a Pentium 4, eight times slower
/// than they are, and products of few columns, as an extended Kalman filter's, are where libraries gain least. The
/// instruction set is chosen at run time. Runs in the caller's thread, allocates nothing.
template <typename T>
void MatMul(bool transpose_a, bool transpose_b, int32_t m, int32_t n, int32_t k, const T* a, int32_t lda, const T* b, int32_t ldb, T* c,
            int32_t ldc, bool accumulate);

/// The lower triangle of C += A Aᵀ; A is m × k. What stands above the diagonal of C afterwards means nothing.
void AddSquare(int32_t m, int32_t k, const double* a, int32_t lda, double* c, int32_t ldc);

}  // namespace metaekf::linalg
