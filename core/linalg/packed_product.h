#pragma once

#include <cstdint>

namespace metaekf::linalg {

/// Products with a first factor that stays the same, C ← P B or C += P B, or with its transpose, of few columns: as an extended Kalman filter's,
/// in which a layer's weights meet a sample and its tangents.
///
/// P is laid out once, in strips of rows that are read from their beginning to their end, and serves both products, so that the caches hold
/// it once. What an element is does not depend on how many columns there are: columns of several products may go through the factor
/// together.

/// Elements of a packed matrix.
int64_t PackedSize(int32_t rows, int32_t columns);

/// @param a  P = op(A) is rows × columns; column-major; T is float or double.
template <typename T>
void Pack(bool transpose_a, int32_t rows, int32_t columns, const T* a, int32_t lda, T* packed);

/// @param packed  aligned for vectors; P, or its transpose, is m × k. @param b  k × n. @param c  m × n; neither overlaps another. Allocates
///   nothing.
template <typename T>
void PackedMatMul(bool transpose_packed, int32_t m, int32_t n, int32_t k, const T* packed, const T* b, int32_t ldb, T* c, int32_t ldc,
                  bool accumulate);

}  // namespace metaekf::linalg
