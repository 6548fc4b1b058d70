// Products of matrices in vectors, with the instruction set chosen at run time.
//
// A tile of C, some vectors of rows by some columns, stays in registers while k runs; each step takes one column of A and one
// row of B. The tile wants A's columns contiguous and at hand, so a strip of A, as high as the tile and kDepth deep, is copied
// to a panel where this pays or where A is transposed, and serves all columns of C; meanwhile the next strip is called for, since weights
// mostly lie beyond the second-level cache and their short columns escape the processor's own foresight. For a transposed A and few columns, as
// when a layer's weights meet one sample and its tangents, the copy would cost more than the product: there both factors are
// contiguous along k, and a tile is a set of scalar products.

#include "core/linalg/products.h"

#include <algorithm>
#include <cstddef>
#include <cstring>
#include <type_traits>

#include "core/linalg/unroll.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/linalg/products.cc"
#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_AVX3_DL)  // little gain over their neighbours, long to compile
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include "core/linalg/lane_sums-inl.h"
#include "core/linalg/store_rows-inl.h"

HWY_BEFORE_NAMESPACE();
namespace metaekf::linalg {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

// Tiles fill the registers: 32 of them with AVX-512, 16 otherwise.
constexpr bool kManyRegisters = HWY_TARGET <= HWY_AVX3;
constexpr int kTileVectors = kManyRegisters ? 4 : 2;
constexpr int kTileColumns = 6;
constexpr int kDotRows = kManyRegisters ? 4 : 2;
constexpr int kDotColumns = 4;
constexpr int kDepth = kManyRegisters ? 128 : 256;  // a panel leaves a third of a first-level cache free
constexpr int kCopyFromTiles = 4;  // tiles of a strip from which on a copy of it pays
constexpr int kDotMaxColumns = 12;
constexpr int kDotMinDepthVectors = 4;
constexpr int kToRead = 0, kToWrite = 1, kSecondLevel = 2, kFirstLevel = 3;  // of __builtin_prefetch
constexpr int kLongWay = 32;  // steps of k, while which what a tile is written to arrives
constexpr int kLine = 64;  // bytes of the cache

/// A matrix that is read by single elements: element (row, column) is at[row · by_row + column · by_column].
template <typename T>
struct Strided {
  const T* at;
  ptrdiff_t by_row, by_column;
};

template <typename T>
struct Target {
  T* at;
  ptrdiff_t ld;
  bool accumulate;
};

/// What will be read next, brought nearer meanwhile: a line of the cache at each step of k.
template <typename T>
struct Ahead {
  const T* at;
  ptrdiff_t by;
};

/// kVectors vectors by kColumns columns of C; of a single vector the first `rows` rows.
template <int kVectors, int kColumns, class D, typename T = hn::TFromD<D>>
HWY_INLINE void Tile(D d, int rows, int k, const T* HWY_RESTRICT a, ptrdiff_t lda, Strided<T> b, Target<T> c, Ahead<T> ahead) {
  const int lanes = static_cast<int>(hn::Lanes(d));
  hn::Vec<D> sums[kColumns][kVectors];
  METAEKF_UNROLL
  for (int j = 0; j < kColumns; ++j) {
    METAEKF_UNROLL
    for (int i = 0; i < kVectors; ++i) sums[j][i] = hn::Zero(d);
  }
  if (k >= kLongWay) {
    METAEKF_UNROLL
    for (int j = 0; j < kColumns; ++j) {
      METAEKF_UNROLL
      for (int i = 0; i < kVectors; ++i) __builtin_prefetch(c.at + j * c.ld + i * lanes, kToWrite, kFirstLevel);
    }
  }
  const T* b_row = b.at;
  for (int l = 0; l < k; ++l, a += lda, b_row += b.by_row, ahead.at += ahead.by) {
    __builtin_prefetch(ahead.at, kToRead, kSecondLevel);
    hn::Vec<D> column[kVectors];
    METAEKF_UNROLL
    for (int i = 0; i < kVectors; ++i) column[i] = hn::LoadU(d, a + i * lanes);
    METAEKF_UNROLL
    for (int j = 0; j < kColumns; ++j) {
      const auto factor = hn::Set(d, b_row[j * b.by_column]);
      METAEKF_UNROLL
      for (int i = 0; i < kVectors; ++i) sums[j][i] = hn::MulAdd(column[i], factor, sums[j][i]);
    }
  }
  if constexpr (kVectors == 1) {
    if (rows < lanes) {
      METAEKF_UNROLL
      for (int j = 0; j < kColumns; ++j) {
        T* to = c.at + j * c.ld;
        if (c.accumulate) {
          StoreRows<true>(d, sums[j][0], rows, to, to);
        } else {
          StoreRows<false>(d, sums[j][0], rows, to, to);
        }
      }
      return;
    }
  }
  METAEKF_UNROLL
  for (int j = 0; j < kColumns; ++j) {
    METAEKF_UNROLL
    for (int i = 0; i < kVectors; ++i) {
      T* to = c.at + j * c.ld + i * lanes;
      hn::StoreU(c.accumulate ? hn::Add(hn::LoadU(d, to), sums[j][i]) : sums[j][i], d, to);
    }
  }
}

/// A tile of `columns` ≤ kMost columns.
template <int kVectors, int kMost = kTileColumns, class D, typename T = hn::TFromD<D>>
HWY_INLINE void TileOf(D d, int rows, int columns, int k, const T* a, ptrdiff_t lda, Strided<T> b, Target<T> c, Ahead<T> ahead) {
  if constexpr (kMost > 1) {
    if (columns < kMost) return TileOf<kVectors, kMost - 1>(d, rows, columns, k, a, lda, b, c, ahead);
  }
  Tile<kVectors, kMost>(d, rows, k, a, lda, b, c, ahead);
}

/// One row of tiles, `columns` wide. They are few and of nearly the same width: in a narrow one sums wait for themselves.
template <int kVectors, class D, typename T = hn::TFromD<D>>
HWY_INLINE void Strip(D d, int rows, int columns, int k, const T* a, ptrdiff_t lda, Strided<T> b, Target<T> c, Ahead<T> ahead) {
  for (int tiles = (columns + kTileColumns - 1) / kTileColumns; tiles > 0; --tiles) {
    const int width = (columns + tiles - 1) / tiles;
    TileOf<kVectors>(d, rows, width, k, a, lda, b, c, ahead);
    ahead.at += kLine / sizeof(T);
    columns -= width;
    b.at += width * b.by_column;
    c.at += width * c.ld;
  }
}

/// Copies a vector of each of four rows so that their elements of each column lie side by side.
template <class D, typename T = hn::TFromD<D>>
HWY_INLINE void CopyFours(D d, const T* HWY_RESTRICT from, ptrdiff_t by_row, T* HWY_RESTRICT to, int ld) {
  const auto row = [&](int i) HWY_ATTR { return hn::LoadU(d, from + i * by_row); };
#if HWY_TARGET == HWY_SCALAR
  (void)ld;
  for (int i = 0; i < 4; ++i) hn::StoreU(row(i), d, to + i);
#else
  // Interleaved within their blocks of 16 bytes; a block then holds what goes into one column, or half of it.
  constexpr int kBlock = 16 / sizeof(T);
  const int lanes = static_cast<int>(hn::Lanes(d));
  HWY_ALIGN T blocks[4 * hn::MaxLanes(D())];
  const auto low01 = hn::InterleaveLower(d, row(0), row(1)), high01 = hn::InterleaveUpper(d, row(0), row(1));
  const auto low23 = hn::InterleaveLower(d, row(2), row(3)), high23 = hn::InterleaveUpper(d, row(2), row(3));
  if constexpr (sizeof(T) == 4) {
    const hn::Repartition<double, D> wide;
    const auto pairs = [&](int column, auto v01, auto v23) HWY_ATTR {
      const auto w01 = hn::BitCast(wide, v01), w23 = hn::BitCast(wide, v23);
      hn::Store(hn::BitCast(d, hn::InterleaveLower(wide, w01, w23)), d, blocks + column * lanes);
      hn::Store(hn::BitCast(d, hn::InterleaveUpper(wide, w01, w23)), d, blocks + (column + 1) * lanes);
    };
    pairs(0, low01, low23);
    pairs(2, high01, high23);
    for (int first = 0; first < lanes; first += kBlock) {
      for (int column = 0; column < kBlock; ++column) std::memcpy(to + (first + column) * ld, blocks + column * lanes + first, 16);
    }
  } else {
    hn::Store(low01, d, blocks);
    hn::Store(high01, d, blocks + lanes);
    hn::Store(low23, d, blocks + 2 * lanes);
    hn::Store(high23, d, blocks + 3 * lanes);
    for (int first = 0; first < lanes; first += kBlock) {
      for (int column = 0; column < kBlock; ++column) {
        std::memcpy(to + (first + column) * ld, blocks + column * lanes + first, 16);
        std::memcpy(to + (first + column) * ld + kBlock, blocks + (2 + column) * lanes + first, 16);
      }
    }
  }
#endif
}

/// Copies `rows` × k of op(A) to a panel of `height` rows, with zeros below.
template <class D, typename T = hn::TFromD<D>>
HWY_INLINE void CopyPanel(D d, int rows, int height, int k, Strided<T> a, T* HWY_RESTRICT panel) {
  const int lanes = static_cast<int>(hn::Lanes(d));
  int i = 0;
  if (a.by_row == 1) {
    for (; i + lanes <= rows; i += lanes) {
      for (int l = 0; l < k; ++l) hn::Store(hn::LoadU(d, a.at + i + l * a.by_column), d, panel + i + l * height);
    }
  } else {
    const hn::ScalableTag<T> whole;
    const int width = static_cast<int>(hn::Lanes(whole));
    for (; i + 4 <= rows; i += 4) {
      const T* row = a.at + i * a.by_row;
      int l = 0;
      for (; l + width <= k; l += width) CopyFours(whole, row + l, a.by_row, panel + i + l * height, height);
      for (; l < k; ++l) {
        for (int j = 0; j < 4; ++j) panel[i + j + l * height] = row[j * a.by_row + l];
      }
    }
  }
  for (int l = 0; l < k; ++l) {
    for (int r = i; r < rows; ++r) panel[r + l * height] = a.at[r * a.by_row + l * a.by_column];
    for (int r = rows; r < height; ++r) panel[r + l * height] = 0;
  }
}

template <class D, typename T = hn::TFromD<D>>
void Panels(D d, int m, int n, int k, Strided<T> a, Strided<T> b, Target<T> c) {
  const int lanes = static_cast<int>(hn::Lanes(d)), height = kTileVectors * lanes;
  HWY_ALIGN T panel[kTileVectors * hn::MaxLanes(D()) * kDepth];
  if (k == 0 && !c.accumulate) {
    for (int j = 0; j < n; ++j) std::fill_n(c.at + j * c.ld, m, T(0));
  }
  for (int depth = 0; depth < k; depth += kDepth, c.accumulate = true) {
    const int part = std::min(kDepth, k - depth);
    const Strided<T> b_part{b.at + depth * b.by_row, b.by_row, b.by_column};
    const auto strip = [&](auto tag, auto vectors, int row, int rows) HWY_ATTR {
      constexpr int kVectors = decltype(vectors)::value;
      const int full = kVectors * static_cast<int>(hn::Lanes(tag));
      const Strided<T> from{a.at + row * a.by_row + depth * a.by_column, a.by_row, a.by_column};
      const Target<T> to{c.at + row, c.ld, c.accumulate};
      const bool copy = a.by_row != 1 || rows != full || n >= kCopyFromTiles * kTileColumns;
      if (copy) CopyPanel(tag, rows, full, part, from, panel);
      const T* const next = row + full < m ? from.at + full * a.by_row : a.at + (depth + kDepth) * a.by_column;
      const Ahead<T> ahead{next, a.by_row == 1 ? a.by_column : a.by_row};
      Strip<kVectors>(tag, rows, n, part, copy ? panel : from.at, copy ? full : a.by_column, b_part, to, ahead);
    };
    int row = 0;
    for (; row + height <= m; row += height) strip(d, std::integral_constant<int, kTileVectors>(), row, height);
    if constexpr (kTileVectors > 2) {
      for (; row + 2 * lanes <= m; row += 2 * lanes) strip(d, std::integral_constant<int, 2>(), row, 2 * lanes);
    }
    for (; row + lanes <= m; row += lanes) strip(d, std::integral_constant<int, 1>(), row, lanes);
    if (row == m) continue;
    const hn::CappedTag<T, std::max<size_t>(hn::MaxLanes(D()) / 2, 1)> half;
    const hn::CappedTag<T, std::max<size_t>(hn::MaxLanes(D()) / 4, 1)> quarter;
    const auto fits = [&](auto tag) { return m - row <= static_cast<int>(hn::Lanes(tag)); };
    if (fits(quarter)) {
      strip(quarter, std::integral_constant<int, 1>(), row, m - row);
    } else if (fits(half)) {
      strip(half, std::integral_constant<int, 1>(), row, m - row);
    } else {
      strip(d, std::integral_constant<int, 1>(), row, m - row);
    }
  }
}

/// kRows rows and kColumns columns of C = AᵀB.
template <int kRows, int kColumns, class D, typename T = hn::TFromD<D>>
HWY_INLINE void DotTile(D d, int k, const T* HWY_RESTRICT a, ptrdiff_t lda, const T* HWY_RESTRICT b, ptrdiff_t ldb, Target<T> c) {
  const int lanes = static_cast<int>(hn::Lanes(d));
  hn::Vec<D> products[kRows][4];
  METAEKF_UNROLL
  for (int i = 0; i < kRows; ++i) {
    METAEKF_UNROLL
    for (int j = 0; j < 4; ++j) products[i][j] = hn::Zero(d);
  }
  int l = 0;
  for (; l + lanes <= k; l += lanes) {
    hn::Vec<D> columns[kColumns];
    METAEKF_UNROLL
    for (int j = 0; j < kColumns; ++j) columns[j] = hn::LoadU(d, b + j * ldb + l);
    METAEKF_UNROLL
    for (int i = 0; i < kRows; ++i) {
      const auto row = hn::LoadU(d, a + i * lda + l);
      METAEKF_UNROLL
      for (int j = 0; j < kColumns; ++j) products[i][j] = hn::MulAdd(row, columns[j], products[i][j]);
    }
  }
  METAEKF_UNROLL
  for (int i = 0; i < kRows; ++i) {
    T sums[4];
    Sums(d, products[i], sums);
    METAEKF_UNROLL
    for (int j = 0; j < kColumns; ++j) {
      T sum = sums[j];
      for (int r = l; r < k; ++r) sum += a[i * lda + r] * b[j * ldb + r];
      T* to = c.at + i + j * c.ld;
      *to = c.accumulate ? *to + sum : sum;
    }
  }
}

template <int kColumns, class D, typename T = hn::TFromD<D>>
HWY_INLINE void DotColumns(D d, int m, int k, const T* a, ptrdiff_t lda, const T* b, ptrdiff_t ldb, Target<T> c) {
  int i = 0;
  for (; i + kDotRows <= m; i += kDotRows) {
    DotTile<kDotRows, kColumns>(d, k, a + i * lda, lda, b, ldb, {c.at + i, c.ld, c.accumulate});
  }
  for (; i < m; ++i) DotTile<1, kColumns>(d, k, a + i * lda, lda, b, ldb, {c.at + i, c.ld, c.accumulate});
}

template <class D, typename T = hn::TFromD<D>>
void Dots(D d, int m, int n, int k, const T* a, ptrdiff_t lda, const T* b, ptrdiff_t ldb, Target<T> c) {
  for (; n >= kDotColumns; n -= kDotColumns, b += kDotColumns * ldb, c.at += kDotColumns * c.ld) {
    DotColumns<kDotColumns>(d, m, k, a, lda, b, ldb, c);
  }
  if (n == 3) return DotColumns<3>(d, m, k, a, lda, b, ldb, c);
  if (n == 2) return DotColumns<2>(d, m, k, a, lda, b, ldb, c);
  if (n == 1) return DotColumns<1>(d, m, k, a, lda, b, ldb, c);
}

/// C = A Bᵀ of few rows and many columns, as a gradient of a small layer's weights over many samples: as Cᵀ = B Aᵀ, where a column of B
/// fills vectors.
template <class D, typename T = hn::TFromD<D>>
void AsTranspose(D d, int m, int n, int k, const T* a, ptrdiff_t lda, const T* b, ptrdiff_t ldb, Target<T> c) {
  constexpr int kRows = 64;
  HWY_ALIGN T buffer[kRows * hn::MaxLanes(D())];
  for (int row = 0; row < n; row += kRows) {
    const int rows = std::min(kRows, n - row);
    Panels(d, rows, m, k, Strided<T>{b + row, 1, ldb}, Strided<T>{a, lda, 1}, Target<T>{buffer, kRows, false});
    for (int j = 0; j < rows; ++j) {
      T* to = c.at + (row + j) * c.ld;
      for (int i = 0; i < m; ++i) to[i] = c.accumulate ? to[i] + buffer[i * kRows + j] : buffer[i * kRows + j];
    }
  }
}

/// C = A Bᵀ of few rows and columns and many samples: stretches of samples are turned round, so that scalar products run along them.
template <class D, typename T = hn::TFromD<D>>
void AsDots(D d, int m, int n, int k, const T* a, ptrdiff_t lda, const T* b, ptrdiff_t ldb, Target<T> c) {
  constexpr int kStretch = 64, kMost = 16;  // rows: fewer than a vector has lanes
  HWY_ALIGN T rows_of_a[kMost * kStretch], rows_of_b[kMost * kStretch];
  const auto turn = [&](const T* from, ptrdiff_t ld, int rows, int columns, T* to) {
    for (int l = 0; l < columns; ++l) {
      for (int i = 0; i < rows; ++i) to[i * kStretch + l] = from[i + l * ld];
    }
  };
  for (int l = 0; l < k; l += kStretch, c.accumulate = true) {
    const int columns = std::min(kStretch, k - l);
    turn(a + l * lda, lda, m, columns, rows_of_a);
    turn(b + l * ldb, ldb, n, columns, rows_of_b);
    Dots(d, m, n, columns, rows_of_a, kStretch, rows_of_b, kStretch, c);
  }
}

template <typename T>
void Product(bool transpose_a, bool transpose_b, int m, int n, int k, const T* a, int lda, const T* b, int ldb, T* c, int ldc,
             bool accumulate) {
  const hn::ScalableTag<T> d;
  const Target<T> to{c, ldc, accumulate};
  const int lanes = static_cast<int>(hn::Lanes(d));
  if (transpose_a && !transpose_b && (n <= kDotMaxColumns || 2 * m < lanes) && k >= kDotMinDepthVectors * lanes) {
    return Dots(d, m, n, k, a, lda, b, ldb, to);
  }
  if (!transpose_a && transpose_b && m < lanes && n < lanes && k >= kDotMinDepthVectors * lanes) return AsDots(d, m, n, k, a, lda, b, ldb, to);
  if (!transpose_a && transpose_b && m < lanes && n >= lanes) return AsTranspose(d, m, n, k, a, lda, b, ldb, to);
  const Strided<T> by_a = transpose_a ? Strided<T>{a, lda, 1} : Strided<T>{a, 1, lda};
  const Strided<T> by_b = transpose_b ? Strided<T>{b, ldb, 1} : Strided<T>{b, 1, ldb};
  Panels(d, m, n, k, by_a, by_b, to);
}

void FloatProduct(bool transpose_a, bool transpose_b, int m, int n, int k, const float* a, int lda, const float* b, int ldb, float* c,
                  int ldc, bool accumulate) {
  Product(transpose_a, transpose_b, m, n, k, a, lda, b, ldb, c, ldc, accumulate);
}
void DoubleProduct(bool transpose_a, bool transpose_b, int m, int n, int k, const double* a, int lda, const double* b, int ldb, double* c,
                   int ldc, bool accumulate) {
  Product(transpose_a, transpose_b, m, n, k, a, lda, b, ldb, c, ldc, accumulate);
}

}  // namespace HWY_NAMESPACE
}  // namespace metaekf::linalg
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace metaekf::linalg {

HWY_EXPORT(FloatProduct);
HWY_EXPORT(DoubleProduct);

namespace {

/// Multiplications below which finding the way to a tile costs more than it saves.
constexpr int64_t kFew = 64, kFewTransposed = 160;

template <bool transpose_b, typename T>
void PlainProduct(bool transpose_a, int32_t m, int32_t n, int32_t k, const T* a, int32_t lda, const T* b, int32_t ldb, T* c,
                  int32_t ldc, bool accumulate) {
  const ptrdiff_t b_row = transpose_b ? ldb : 1;
  for (int32_t j = 0; j < n; ++j) {
    T* column = c + ptrdiff_t{j} * ldc;
    if (!accumulate) std::fill_n(column, m, T(0));
    if (k == 0) continue;  // a and b may be null
    const T* b_column = transpose_b ? b + j : b + ptrdiff_t{j} * ldb;
    if (!transpose_a) {
      for (int32_t l = 0; l < k; ++l) {
        const T* a_column = a + ptrdiff_t{l} * lda;
        for (int32_t i = 0; i < m; ++i) column[i] += a_column[i] * b_column[l * b_row];
      }
      continue;
    }
    int32_t i = 0;
    for (; i + 4 <= m; i += 4) {  // four sums that need not wait for each other
      const T* row = a + ptrdiff_t{i} * lda;
      T sums[4] = {};
      for (int32_t l = 0; l < k; ++l) {
        for (int32_t r = 0; r < 4; ++r) sums[r] += row[r * ptrdiff_t{lda} + l] * b_column[l * b_row];
      }
      for (int32_t r = 0; r < 4; ++r) column[i + r] += sums[r];
    }
    for (; i < m; ++i) {
      const T* row = a + ptrdiff_t{i} * lda;
      T sum = 0;
      for (int32_t l = 0; l < k; ++l) sum += row[l] * b_column[l * b_row];
      column[i] += sum;
    }
  }
}

}  // namespace

template <typename T>
void MatMul(bool transpose_a, bool transpose_b, int32_t m, int32_t n, int32_t k, const T* a, int32_t lda, const T* b, int32_t ldb, T* c,
            int32_t ldc, bool accumulate) {
  if (int64_t{m} * n * k < (transpose_a ? kFewTransposed : kFew)) {
    return transpose_b ? PlainProduct<true>(transpose_a, m, n, k, a, lda, b, ldb, c, ldc, accumulate)
                       : PlainProduct<false>(transpose_a, m, n, k, a, lda, b, ldb, c, ldc, accumulate);
  }
  if constexpr (sizeof(T) == sizeof(float)) {
    HWY_DYNAMIC_DISPATCH(FloatProduct)(transpose_a, transpose_b, m, n, k, a, lda, b, ldb, c, ldc, accumulate);
  } else {
    HWY_DYNAMIC_DISPATCH(DoubleProduct)(transpose_a, transpose_b, m, n, k, a, lda, b, ldb, c, ldc, accumulate);
  }
}

template void MatMul(bool, bool, int32_t, int32_t, int32_t, const float*, int32_t, const float*, int32_t, float*, int32_t, bool);
template void MatMul(bool, bool, int32_t, int32_t, int32_t, const double*, int32_t, const double*, int32_t, double*, int32_t, bool);

void AddSquare(int32_t m, int32_t k, const double* a, int32_t lda, double* c, int32_t ldc) {
  constexpr int32_t kWidth = 24;  // of a strip of C; what it has above the diagonal is computed for nothing
  constexpr int32_t kSamples = 96;  // so many columns of A that what a strip reads stays near
  for (int32_t l = 0; l < k; l += kSamples) {
    const double* part = a + int64_t{l} * lda;
    const int32_t samples = std::min(kSamples, k - l);
    for (int32_t j = 0; j < m; j += kWidth) {
      MatMul(false, true, m - j, std::min(kWidth, m - j), samples, part + j, lda, part + j, lda, c + j + int64_t{j} * ldc, ldc, true);
    }
  }
}

}  // namespace metaekf::linalg
#endif  // HWY_ONCE
