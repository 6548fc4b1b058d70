// Kernels in vectors, with the instruction set chosen at run time.
//
// In a recurrence of a small network each step waits for the last, and its values are a few numbers long. What counts there is how many
// instructions a step takes and how soon its results can be read: a processor hands on what was just stored only to a load that asks for
// no more than one store wrote. So every kernel reads and writes a column of r rows in the same pieces: whole vectors, then the largest
// power of two that fits, and so on.

#include <algorithm>
#include <cstddef>

#include "core/autodiff/kernel.h"
#include "core/linalg/unroll.h"

#ifndef METAEKF_PANEL_HEIGHT  // once, not for each instruction set
#define METAEKF_PANEL_HEIGHT
namespace metaekf::autodiff {
/// Rows of a panel for so many rows of a factor: whole vectors of any instruction set.
constexpr ptrdiff_t PanelHeight(int32_t rows) { return (ptrdiff_t{rows} + 15) / 16 * 16; }
}  // namespace metaekf::autodiff
#endif

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/autodiff/vector_kernels.cc"
#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_AVX3_DL)  // little gain over their neighbours, long to compile
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include "core/linalg/store_rows-inl.h"

HWY_BEFORE_NAMESPACE();
namespace metaekf::autodiff {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

// ---- elementwise ----

struct Sum {
  template <class V>
  static HWY_INLINE V Apply(V a, V b) {
    return hn::Add(a, b);
  }
};

struct Difference {
  template <class V>
  static HWY_INLINE V Apply(V a, V b) {
    return hn::Sub(a, b);
  }
};

struct ElementProduct {
  template <class V>
  static HWY_INLINE V Apply(V a, V b) {
    return hn::Mul(a, b);
  }
};

/// out_k = Operation(a_k, b_k), k < count, count below the lanes of two vectors.
template <class Operation, class D, typename T = hn::TFromD<D>>
HWY_INLINE void EndOfPairs(D d, int64_t count, const T* a, const T* b, T* out) {
  const int64_t lanes = static_cast<int64_t>(hn::Lanes(d));
  if (count >= lanes) {
    hn::StoreU(Operation::Apply(hn::LoadU(d, a), hn::LoadU(d, b)), d, out);
    a += lanes, b += lanes, out += lanes, count -= lanes;
  }
  if constexpr (hn::MaxLanes(D()) > 1) {
    if (count > 0) EndOfPairs<Operation>(hn::Half<D>(), count, a, b, out);
  }
}

template <class Operation, typename T>
HWY_INLINE void PairsOf(int64_t count, const T* a, const T* b, T* out) {
  const hn::ScalableTag<T> d;
  const int64_t lanes = static_cast<int64_t>(hn::Lanes(d));
  for (; count >= lanes; count -= lanes, a += lanes, b += lanes, out += lanes) {
    hn::StoreU(Operation::Apply(hn::LoadU(d, a), hn::LoadU(d, b)), d, out);
  }
  EndOfPairs<Operation>(d, count, a, b, out);
}

template <class Operation, typename T>
void Pairs(const Instruction& i, const Places<T>& at) {
  PairsOf<Operation>(int64_t{i.rows} * i.cols, at.a, at.b, at.out);
}

/// Where one of the two is tiled.
template <class Operation, typename T>
void TiledPairs(const Instruction& i, const Places<T>& at) {
  if (i.b.tile_width != 0) {
    ForEachTile(i, i.b, [&](int64_t to, int64_t from, int64_t size) { PairsOf<Operation>(size, at.a + to, at.b + from, at.out + to); });
  } else {
    ForEachTile(i, i.a, [&](int64_t to, int64_t from, int64_t size) { PairsOf<Operation>(size, at.a + from, at.b + to, at.out + to); });
  }
}

/// out = factor · a
template <typename T>
HWY_INLINE void Scaled(T factor, const T* a, T* out, int64_t count) {
  const hn::ScalableTag<T> d;
  const int64_t lanes = static_cast<int64_t>(hn::Lanes(d));
  const auto factors = hn::Set(d, factor);
  int64_t k = 0;
  for (; k + lanes <= count; k += lanes) hn::StoreU(hn::Mul(factors, hn::LoadU(d, a + k)), d, out + k);
  for (; k < count; ++k) out[k] = factor * a[k];
}

template <typename T>
void Scale(const Instruction& i, const Places<T>& at) {
  Scaled(T(i.scalar), at.a, at.out, int64_t{i.rows} * i.cols);
}

template <typename T>
void ScaleBy(const Instruction& i, const Places<T>& at) {
  Scaled(*at.a, at.b, at.out, int64_t{i.rows} * i.cols);
}

// ---- products with a panel ----

/// `rows` rows, which fill more than kVectors − 1 vectors but no more than kVectors, of one column of C. What an element is depends
/// neither on kVectors nor on the width of vectors.
template <int kVectors, bool kAdd, class D, typename T = hn::TFromD<D>>
HWY_INLINE void PanelRows(D d, int rows, int k, const T* HWY_RESTRICT panel, ptrdiff_t height, const T* b, const T* addend, T* c) {
  const int lanes = static_cast<int>(hn::Lanes(d));
  // Four sums of each: a single one would wait for itself.
  constexpr int kSums = 4;
  hn::Vec<D> sums[kSums][kVectors];
  METAEKF_UNROLL
  for (int s = 0; s < kSums; ++s) {
    METAEKF_UNROLL
    for (int i = 0; i < kVectors; ++i) sums[s][i] = hn::Zero(d);
  }
  int l = 0;
  for (; l + kSums <= k; l += kSums, panel += kSums * height) {
    METAEKF_UNROLL
    for (int s = 0; s < kSums; ++s) {
      const auto factor = hn::Set(d, b[l + s]);
      METAEKF_UNROLL
      for (int i = 0; i < kVectors; ++i) sums[s][i] = hn::MulAdd(hn::Load(d, panel + s * height + i * lanes), factor, sums[s][i]);
    }
  }
  METAEKF_UNROLL
  for (int s = 0; s < kSums - 1; ++s) {
    if (l + s < k) {
      const auto factor = hn::Set(d, b[l + s]);
      METAEKF_UNROLL
      for (int i = 0; i < kVectors; ++i) sums[s][i] = hn::MulAdd(hn::Load(d, panel + s * height + i * lanes), factor, sums[s][i]);
    }
  }
  METAEKF_UNROLL
  for (int i = 0; i < kVectors; ++i, rows -= lanes, addend += lanes, c += lanes) {
    const auto sum = hn::Add(hn::Add(sums[0][i], sums[1][i]), hn::Add(sums[2][i], sums[3][i]));
    linalg::HWY_NAMESPACE::StoreRows<kAdd>(d, sum, rows, addend, c);
  }
}

/// One column of C, of at most sixteen rows, as the steps of small recurrences want it.
template <int kVectors, bool kAdd, class D>
void PanelColumn(const Instruction& i, const Places<hn::TFromD<D>>& at) {
  PanelRows<kVectors, kAdd>(D(), i.rows, i.inner, at.panel, PanelHeight(1), at.b, at.c, at.out);
}

/// C ← op(A) B or D + op(A) B.
template <bool kAdd, typename T>
void PanelProduct(const Instruction& i, const Places<T>& at) {
  const hn::ScalableTag<T> d;
  const int lanes = static_cast<int>(hn::Lanes(d));
  const ptrdiff_t height = PanelHeight(i.rows);
  for (int32_t j = 0; j < i.cols; ++j) {
    const T* b = at.b + ptrdiff_t{j} * i.b.ld;
    const T* addend = at.c + ptrdiff_t{j} * i.c.ld;
    T* c = at.out + ptrdiff_t{j} * i.out.ld;
    int row = 0;
    for (; i.rows - row > lanes; row += 2 * lanes) {
      PanelRows<2, kAdd>(d, i.rows - row, i.inner, at.panel + row, height, b, addend + row, c + row);
    }
    if (row < i.rows) PanelRows<1, kAdd>(d, i.rows - row, i.inner, at.panel + row, height, b, addend + row, c + row);
  }
}

template <bool kAdd, typename T>
Kernel<T> SelectPanelProduct(const Instruction& i) {
  using Wide = hn::ScalableTag<T>;
  using Narrow = hn::CappedTag<T, 4>;
  if (i.cols > 1 || PanelHeight(i.rows) > PanelHeight(1)) return PanelProduct<kAdd, T>;
  if (i.rows <= static_cast<int>(hn::Lanes(Narrow()))) return PanelColumn<1, kAdd, Narrow>;
  if (i.rows <= static_cast<int>(hn::Lanes(Wide()))) return PanelColumn<1, kAdd, Wide>;
  if (i.rows <= 2 * static_cast<int>(hn::Lanes(Wide()))) return PanelColumn<2, kAdd, Wide>;
  return PanelProduct<kAdd, T>;
}

// ---- small products ----

/// aᵀb of kDepth elements, or of `depth` if kDepth is 0.
template <int kDepth, typename T>
HWY_INLINE T ScalarProduct(int depth, const T* HWY_RESTRICT a, const T* HWY_RESTRICT b) {
  T sum = 0;
  if constexpr (kDepth > 0) {
    METAEKF_UNROLL
    for (int l = 0; l < kDepth; ++l) sum += a[l] * b[l];
  } else {
    const hn::ScalableTag<T> d;
    const int lanes = static_cast<int>(hn::Lanes(d));
    auto sums = hn::Zero(d);
    int l = 0;
    for (; l + lanes <= depth; l += lanes) sums = hn::MulAdd(hn::LoadU(d, a + l), hn::LoadU(d, b + l), sums);
    sum = hn::GetLane(hn::SumOfLanes(d, sums));
    for (; l < depth; ++l) sum += a[l] * b[l];
  }
  return sum;
}

/// C ← AᵀB or D + AᵀB of few elements, as an extended Kalman filter of a small model has by the dozen; of kRows rows and depth kDepth,
/// where these are not 0.
template <int kRows, int kDepth, bool kAdd, typename T>
void SmallProduct(const Instruction& i, const Places<T>& at) {
  const int depth = i.inner;
  const ptrdiff_t lda = i.a.ld;
  const T* b = at.b;
  const T* addend = at.c;
  T* c = at.out;
  for (int32_t j = 0; j < i.cols; ++j, b += i.b.ld, addend += i.c.ld, c += i.out.ld) {
    const T* a = at.a;
    const auto row = [&](int r) {
      const T sum = ScalarProduct<kDepth>(depth, a, b);
      c[r] = kAdd ? addend[r] + sum : sum;
      a += lda;
    };
    if constexpr (kRows > 0) {
      METAEKF_UNROLL
      for (int r = 0; r < kRows; ++r) row(r);
    } else {
      for (int r = 0; r < i.rows; ++r) row(r);
    }
  }
}

/// v ← so many vectors of elements that lie in turns.
template <class D, class V = hn::Vec<D>>
HWY_INLINE void LoadTurns(D d, const hn::TFromD<D>* from, V (&v)[2]) {
  hn::LoadInterleaved2(d, from, v[0], v[1]);
}
template <class D, class V = hn::Vec<D>>
HWY_INLINE void LoadTurns(D d, const hn::TFromD<D>* from, V (&v)[3]) {
  hn::LoadInterleaved3(d, from, v[0], v[1], v[2]);
}
template <class D, class V = hn::Vec<D>>
HWY_INLINE void LoadTurns(D d, const hn::TFromD<D>* from, V (&v)[4]) {
  hn::LoadInterleaved4(d, from, v[0], v[1], v[2], v[3]);
}

/// SmallProduct to the bit, of many rows that lie one behind the other: a network's first layer.
template <int kDepth, bool kAdd, typename T>
void TallProduct(const Instruction& i, const Places<T>& at) {
  const hn::ScalableTag<T> d;
  const int lanes = static_cast<int>(hn::Lanes(d)), rows = i.rows;
  const T* b = at.b;
  const T* addend = at.c;
  T* c = at.out;
  for (int32_t j = 0; j < i.cols; ++j, b += i.b.ld, addend += i.c.ld, c += i.out.ld) {
    const T* a = at.a;
    int r = 0;
    for (; r + lanes <= rows; r += lanes, a += kDepth * lanes) {
      hn::Vec<decltype(d)> columns[kDepth];
      LoadTurns(d, a, columns);
      auto sum = hn::Mul(columns[0], hn::Set(d, b[0]));
      METAEKF_UNROLL
      for (int l = 1; l < kDepth; ++l) sum = hn::MulAdd(columns[l], hn::Set(d, b[l]), sum);
      if constexpr (kAdd) sum = hn::Add(hn::LoadU(d, addend + r), sum);
      hn::StoreU(sum, d, c + r);
    }
    for (; r < rows; ++r, a += kDepth) {
      const T sum = ScalarProduct<kDepth>(kDepth, a, b);
      c[r] = kAdd ? addend[r] + sum : sum;
    }
  }
}

template <int kDepth, bool kAdd, typename T>
Kernel<T> SelectSmallProduct(const Instruction& i) {
  switch (i.rows) {
    case 1:
      return SmallProduct<1, kDepth, kAdd, T>;
    case 2:
      return SmallProduct<2, kDepth, kAdd, T>;
    case 3:
      return SmallProduct<3, kDepth, kAdd, T>;
    case 4:
      return SmallProduct<4, kDepth, kAdd, T>;
    default:
      break;
  }
  if constexpr (kDepth > 1) {
    if (i.a.ld == kDepth && i.rows >= static_cast<int>(hn::Lanes(hn::ScalableTag<T>()))) return TallProduct<kDepth, kAdd, T>;
  }
  return SmallProduct<0, kDepth, kAdd, T>;
}

template <bool kAdd, typename T>
Kernel<T> SelectProduct(const Instruction& i) {
  if (i.panel >= 0) return SelectPanelProduct<kAdd, T>(i);
  constexpr int64_t kFew = 256;  // multiplications
  if (!i.transpose_a || i.transpose_b || (kAdd && i.c.tile_width != 0) || int64_t{i.rows} * i.cols * i.inner > kFew) return nullptr;
  switch (i.inner) {
    case 1:
      return SelectSmallProduct<1, kAdd, T>(i);
    case 2:
      return SelectSmallProduct<2, kAdd, T>(i);
    case 3:
      return SelectSmallProduct<3, kAdd, T>(i);
    case 4:
      return SelectSmallProduct<4, kAdd, T>(i);
    default:
      return SmallProduct<0, 0, kAdd, T>;
  }
}

template <typename T>
Kernel<T> Select(const Instruction& i) {
  const bool tiled = i.a.tile_width != 0 || i.b.tile_width != 0;
  switch (i.op) {
    case Opcode::kMatMul:
      return SelectProduct<false, T>(i);
    case Opcode::kMatMulAdd:
      return SelectProduct<true, T>(i);
    case Opcode::kAdd:
      return tiled ? TiledPairs<Sum, T> : Pairs<Sum, T>;
    case Opcode::kSub:
      return tiled ? TiledPairs<Difference, T> : Pairs<Difference, T>;
    case Opcode::kMul:
      return tiled ? TiledPairs<ElementProduct, T> : Pairs<ElementProduct, T>;
    case Opcode::kScale:
      return Scale<T>;
    case Opcode::kScaleBy:
      return ScaleBy<T>;
    default:
      return nullptr;
  }
}

Kernel<float> SelectFloat(const Instruction& i) { return Select<float>(i); }
Kernel<double> SelectDouble(const Instruction& i) { return Select<double>(i); }

}  // namespace HWY_NAMESPACE
}  // namespace metaekf::autodiff
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace metaekf::autodiff {

HWY_EXPORT(SelectFloat);
HWY_EXPORT(SelectDouble);

template <>
Kernel<float> SelectVectorKernel(const Instruction& i) {
  return HWY_DYNAMIC_DISPATCH(SelectFloat)(i);
}

template <>
Kernel<double> SelectVectorKernel(const Instruction& i) {
  return HWY_DYNAMIC_DISPATCH(SelectDouble)(i);
}

int64_t PanelSize(int32_t rows, int32_t inner) { return int64_t{PanelHeight(rows)} * inner; }

template <typename T>
void MakePanel(const Instruction& i, const Places<T>& at) {
  const T* a = at.a;
  T* panel = at.panel;
  for (int32_t l = 0; l < i.inner; ++l, panel += PanelHeight(i.rows)) {
    std::fill_n(panel, PanelHeight(i.rows), T(0));
    for (int32_t r = 0; r < i.rows; ++r) panel[r] = i.transpose_a ? a[l + ptrdiff_t{r} * i.a.ld] : a[r + ptrdiff_t{l} * i.a.ld];
  }
}
template void MakePanel(const Instruction&, const Places<float>&);
template void MakePanel(const Instruction&, const Places<double>&);

}  // namespace metaekf::autodiff
#endif  // HWY_ONCE
