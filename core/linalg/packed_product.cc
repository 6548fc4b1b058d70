// Products with a packed factor in vectors, with the instruction set chosen at run time.
//
// Strips are kStripRows rows high, whatever the instruction set, and lie one behind the other, column by column. A tile of C, some vectors
// of rows by some columns, stays in registers while k runs; its vectors of A may come from several strips. If A is transposed, its columns
// in the strips are what a tile is scalar products of.

#include "core/linalg/packed_product.h"

#include <algorithm>
#include <cstddef>

#include "core/linalg/unroll.h"

#ifndef METAEKF_STRIP_ROWS  // once, not for each instruction set
#define METAEKF_STRIP_ROWS
namespace metaekf::linalg {
/// Whole vectors of any instruction set.
constexpr int kStripRows = 16;
}  // namespace metaekf::linalg
#endif

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/linalg/packed_product.cc"
#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_AVX3_DL)  // little gain over their neighbours, long to compile
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include "core/linalg/lane_sums-inl.h"

HWY_BEFORE_NAMESPACE();
namespace metaekf::linalg {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

constexpr bool kManyRegisters = HWY_TARGET <= HWY_AVX3;  // 32 of them with AVX-512, 16 otherwise
constexpr int kTileColumns = kManyRegisters ? 8 : 6;

/// Vectors of rows in a tile: so many that sums need not wait for themselves, and no more than registers hold.
constexpr int VectorsFor(int columns) { return columns == 1 ? 8 : columns <= 3 ? 4 : kManyRegisters && columns <= 6 ? 4 : 2; }

template <typename T>
struct PackedProductOf {
  int m, k;
  const T* a;
  const T* b;
  ptrdiff_t ldb;
  T* c;
  ptrdiff_t ldc;
  bool accumulate;
};

/// kVectors vectors of rows from `row` on by kColumns columns from `column` on. Not inlined: called from many places, and long.
template <int kVectors, int kColumns, class D, typename T = hn::TFromD<D>>
void Tile(D d, const PackedProductOf<T>& p, int row, int column) {
  const int lanes = static_cast<int>(hn::Lanes(d));
  hn::Vec<D> sums[kColumns][kVectors];
  const T* strips[kVectors];
  METAEKF_UNROLL
  for (int i = 0; i < kVectors; ++i) {
    const int first = row + i * lanes;
    strips[i] = p.a + ptrdiff_t{first / kStripRows} * kStripRows * p.k + first % kStripRows;
    METAEKF_UNROLL
    for (int j = 0; j < kColumns; ++j) sums[j][i] = hn::Zero(d);
  }
  const T* const b = p.b + column * p.ldb;
  for (ptrdiff_t l = 0; l < p.k; ++l) {
    // Of the two factors the one that is fewer registers stays in them.
    if constexpr (kVectors > kColumns) {
      hn::Vec<D> factors[kColumns];
      METAEKF_UNROLL
      for (int j = 0; j < kColumns; ++j) factors[j] = hn::Set(d, b[l + j * p.ldb]);
      METAEKF_UNROLL
      for (int i = 0; i < kVectors; ++i) {
        const auto rows = hn::Load(d, strips[i] + l * kStripRows);
        METAEKF_UNROLL
        for (int j = 0; j < kColumns; ++j) sums[j][i] = hn::MulAdd(rows, factors[j], sums[j][i]);
      }
    } else {
      hn::Vec<D> rows[kVectors];
      METAEKF_UNROLL
      for (int i = 0; i < kVectors; ++i) rows[i] = hn::Load(d, strips[i] + l * kStripRows);
      METAEKF_UNROLL
      for (int j = 0; j < kColumns; ++j) {
        const auto factor = hn::Set(d, b[l + j * p.ldb]);
        METAEKF_UNROLL
        for (int i = 0; i < kVectors; ++i) sums[j][i] = hn::MulAdd(rows[i], factor, sums[j][i]);
      }
    }
  }
  METAEKF_UNROLL
  for (int j = 0; j < kColumns; ++j) {
    METAEKF_UNROLL
    for (int i = 0; i < kVectors; ++i) {
      const int first = row + i * lanes;
      T* const to = p.c + first + (column + j) * p.ldc;
      if (first + lanes <= p.m) {
        hn::StoreU(p.accumulate ? hn::Add(hn::LoadU(d, to), sums[j][i]) : sums[j][i], d, to);
        continue;
      }
      HWY_ALIGN T buffer[hn::MaxLanes(D())];
      hn::Store(sums[j][i], d, buffer);
      for (int r = 0; r < p.m - first; ++r) to[r] = p.accumulate ? to[r] + buffer[r] : buffer[r];
    }
  }
}

/// Rows from `row` on in tiles of kColumns columns, the last of them one narrower: of nearly the same width, so that none waits for its sums.
template <int kVectors, int kColumns, class D, typename T = hn::TFromD<D>>
HWY_INLINE void Rows(D d, const PackedProductOf<T>& p, int row, int tiles, int wide) {
  const int lanes = static_cast<int>(hn::Lanes(d));
  for (; row + (kVectors - 1) * lanes < p.m; row += kVectors * lanes) {
    int column = 0;
    for (int tile = 0; tile < wide; ++tile, column += kColumns) Tile<kVectors, kColumns>(d, p, row, column);
    if constexpr (kColumns > 1) {
      for (int tile = wide; tile < tiles; ++tile, column += kColumns - 1) Tile<kVectors, kColumns - 1>(d, p, row, column);
    }
  }
  if constexpr (kVectors > 1) Rows<kVectors / 2, kColumns>(d, p, row, tiles, wide);
}

template <int kColumns, class D, typename T = hn::TFromD<D>>
HWY_INLINE void TilesOf(D d, const PackedProductOf<T>& p, int n, int tiles, int width) {
  if constexpr (kColumns > 1) {
    if (width < kColumns) return TilesOf<kColumns - 1>(d, p, n, tiles, width);
  }
  Rows<VectorsFor(kColumns), kColumns>(d, p, 0, tiles, n - tiles * (kColumns - 1));
}

/// kRows rows of C = AᵀB from `row` on, by kColumns columns from `column` on.
template <int kRows, int kColumns, class D, typename T = hn::TFromD<D>>
void TransposedTile(D d, const PackedProductOf<T>& p, int row, int column) {
  const int lanes = static_cast<int>(hn::Lanes(d));
  hn::Vec<D> products[kRows][4];
  METAEKF_UNROLL
  for (int i = 0; i < kRows; ++i) {
    METAEKF_UNROLL
    for (int j = 0; j < 4; ++j) products[i][j] = hn::Zero(d);
  }
  const T* const b = p.b + column * p.ldb;
  const auto add = [&](int first, const hn::Vec<D>* factors) HWY_ATTR {
    const T* const a = p.a + ptrdiff_t{first / kStripRows} * kStripRows * p.m + first % kStripRows + ptrdiff_t{row} * kStripRows;
    METAEKF_UNROLL
    for (int i = 0; i < kRows; ++i) {
      const auto rows = hn::Load(d, a + i * kStripRows);
      METAEKF_UNROLL
      for (int j = 0; j < kColumns; ++j) products[i][j] = hn::MulAdd(rows, factors[j], products[i][j]);
    }
  };
  hn::Vec<D> factors[kColumns];
  int l = 0;
  for (; l + lanes <= p.k; l += lanes) {
    METAEKF_UNROLL
    for (int j = 0; j < kColumns; ++j) factors[j] = hn::LoadU(d, b + l + j * p.ldb);
    add(l, factors);
  }
  if (l < p.k) {
    HWY_ALIGN T rest[hn::MaxLanes(D())];
    METAEKF_UNROLL
    for (int j = 0; j < kColumns; ++j) {
      for (int r = 0; r < lanes; ++r) rest[r] = l + r < p.k ? b[l + r + j * p.ldb] : T(0);
      factors[j] = hn::Load(d, rest);
    }
    add(l, factors);
  }
  METAEKF_UNROLL
  for (int i = 0; i < kRows; ++i) {
    T sums[4];
    Sums(d, products[i], sums);
    METAEKF_UNROLL
    for (int j = 0; j < kColumns; ++j) {
      T* const to = p.c + row + i + (column + j) * p.ldc;
      *to = p.accumulate ? *to + sums[j] : sums[j];
    }
  }
}

/// kRows rows of C = AᵀB from `row` on.
template <int kRows, class D, typename T = hn::TFromD<D>>
HWY_INLINE void TransposedRows(D d, const PackedProductOf<T>& p, int n, int row) {
  int column = 0;
  for (; column + 4 <= n; column += 4) TransposedTile<kRows, 4>(d, p, row, column);
  if (n - column == 3) TransposedTile<kRows, 3>(d, p, row, column);
  if (n - column == 2) TransposedTile<kRows, 2>(d, p, row, column);
  if (n - column == 1) TransposedTile<kRows, 1>(d, p, row, column);
}

template <typename T>
void TransposedProduct(const PackedProductOf<T>& p, int n) {
  constexpr int kRows = kManyRegisters ? 4 : 2;
  const hn::ScalableTag<T> d;
  int row = 0;
  for (; row + kRows <= p.m; row += kRows) TransposedRows<kRows>(d, p, n, row);
  for (; row < p.m; ++row) TransposedRows<1>(d, p, n, row);
}

template <typename T>
void Product(bool transpose, const PackedProductOf<T>& p, int n) {
  if (transpose) return TransposedProduct(p, n);
  if (n == 0) return;
  const int tiles = (n + kTileColumns - 1) / kTileColumns;
  TilesOf<kTileColumns>(hn::ScalableTag<T>(), p, n, tiles, (n + tiles - 1) / tiles);
}

void PackedFloatProduct(bool transpose, int m, int n, int k, const float* a, const float* b, int ldb, float* c, int ldc, bool accumulate) {
  Product(transpose, PackedProductOf<float>{m, k, a, b, ldb, c, ldc, accumulate}, n);
}
void PackedDoubleProduct(bool transpose, int m, int n, int k, const double* a, const double* b, int ldb, double* c, int ldc, bool accumulate) {
  Product(transpose, PackedProductOf<double>{m, k, a, b, ldb, c, ldc, accumulate}, n);
}

}  // namespace HWY_NAMESPACE
}  // namespace metaekf::linalg
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace metaekf::linalg {

HWY_EXPORT(PackedFloatProduct);
HWY_EXPORT(PackedDoubleProduct);

int64_t PackedSize(int32_t rows, int32_t columns) { return (int64_t{rows} + kStripRows - 1) / kStripRows * kStripRows * columns; }

template <typename T>
void Pack(bool transpose_a, int32_t rows, int32_t columns, const T* a, int32_t lda, T* packed) {
  const ptrdiff_t by_row = transpose_a ? lda : 1, by_column = transpose_a ? 1 : lda;
  for (int32_t row = 0; row < rows; row += kStripRows) {
    const int32_t height = std::min(kStripRows, rows - row);
    for (int32_t l = 0; l < columns; ++l, packed += kStripRows) {
      for (int32_t r = 0; r < height; ++r) packed[r] = a[(row + r) * by_row + l * by_column];
      std::fill(packed + height, packed + kStripRows, T(0));
    }
  }
}

template <typename T>
void PackedMatMul(bool transpose_packed, int32_t m, int32_t n, int32_t k, const T* packed, const T* b, int32_t ldb, T* c, int32_t ldc,
                  bool accumulate) {
  if constexpr (sizeof(T) == sizeof(float)) {
    HWY_DYNAMIC_DISPATCH(PackedFloatProduct)(transpose_packed, m, n, k, packed, b, ldb, c, ldc, accumulate);
  } else {
    HWY_DYNAMIC_DISPATCH(PackedDoubleProduct)(transpose_packed, m, n, k, packed, b, ldb, c, ldc, accumulate);
  }
}

template void Pack(bool, int32_t, int32_t, const float*, int32_t, float*);
template void Pack(bool, int32_t, int32_t, const double*, int32_t, double*);
template void PackedMatMul(bool, int32_t, int32_t, int32_t, const float*, const float*, int32_t, float*, int32_t, bool);
template void PackedMatMul(bool, int32_t, int32_t, int32_t, const double*, const double*, int32_t, double*, int32_t, bool);

}  // namespace metaekf::linalg
#endif  // HWY_ONCE
