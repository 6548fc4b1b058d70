#pragma once

#include <cstdint>

namespace metaekf::linalg {

/// Products with a first factor that stays the same, C ← op(A) B or C += op(A) B, of few columns: as an extended Kalman filter's, in which a
/// layer's weights meet a sample and its tangents.
///
/// The factor is laid out once, in strips of rows that are read from their beginning to their end. So nothing is turned round and no
/// lanes are summed in a product, and what an element is does not depend on how many columns there are: columns of several products
/// may go through the factor together.

/// Elements of a packed m × k matrix.
int64_t PackedSize(int32_t m, int32_t k);

/// @param a  op(A) is m × k, column-major; T is float or double.
template <typename T>
void Pack(bool transpose_a, int32_t m, int32_t k, const T* a, int32_t lda, T* packed);

/// @param packed  op(A), aligned for vectors. @param b  k × n. @param c  m × n; neither overlaps another. Allocates nothing.
template <typename T>
void PackedMatMul(int32_t m, int32_t n, int32_t k, const T* packed, const T* b, int32_t ldb, T* c, int32_t ldc, bool accumulate);

}  // namespace metaekf::linalg
