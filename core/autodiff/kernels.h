#pragma once

#include <cstdint>

namespace metaekf::autodiff {

/// C ← op(A) op(B), or C += op(A) op(B) if `accumulate`; op(A) is m × k, op(B) k × n, all column-major.
///
/// Small products run in plain loops, where the call of a library would cost more than the work; the others in
/// OpenBLAS, which picks its kernel for the processor at run time and is kept to one thread.
template <typename T>
void MatMul(bool transpose_a, bool transpose_b, int32_t m, int32_t n, int32_t k, const T* a, int32_t lda, const T* b,
            int32_t ldb, T* c, int32_t ldc, bool accumulate);

}  // namespace metaekf::autodiff
