// Included once for each instruction set.
#if defined(METAEKF_LANE_SUMS_INL) == defined(HWY_TARGET_TOGGLE)
#ifdef METAEKF_LANE_SUMS_INL
#undef METAEKF_LANE_SUMS_INL
#else
#define METAEKF_LANE_SUMS_INL
#endif

#include <hwy/highway.h>

#include "core/linalg/unroll.h"

HWY_BEFORE_NAMESPACE();
namespace metaekf::linalg {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// The sums over the lanes of four vectors.
template <class D, typename T = hn::TFromD<D>>
HWY_INLINE void Sums(D d, const hn::Vec<D>* v, T* sums) {
#if HWY_TARGET == HWY_SCALAR
  METAEKF_UNROLL
  for (int i = 0; i < 4; ++i) sums[i] = hn::GetLane(v[i]);
  (void)d;
#else
  // Pairs of vectors are folded within their blocks of 16 bytes until one block holds a lane of each; blocks are added last.
  const hn::CappedTag<T, 16 / sizeof(T)> block;
  const int lanes = static_cast<int>(hn::Lanes(d)), step = static_cast<int>(hn::Lanes(block));
  HWY_ALIGN T folded[2 * hn::MaxLanes(D())];
  const auto t0 = hn::Add(hn::InterleaveLower(d, v[0], v[1]), hn::InterleaveUpper(d, v[0], v[1]));
  const auto t1 = hn::Add(hn::InterleaveLower(d, v[2], v[3]), hn::InterleaveUpper(d, v[2], v[3]));
  int vectors = 2;
  if constexpr (sizeof(T) == 4) {
    const hn::Repartition<double, D> wide;
    const auto w0 = hn::BitCast(wide, t0), w1 = hn::BitCast(wide, t1);
    hn::Store(hn::Add(hn::BitCast(d, hn::InterleaveLower(wide, w0, w1)), hn::BitCast(d, hn::InterleaveUpper(wide, w0, w1))), d, folded);
    vectors = 1;
  } else {
    hn::Store(t0, d, folded);
    hn::Store(t1, d, folded + lanes);
  }
  for (int i = 0; i < vectors; ++i) {
    auto sum = hn::Load(block, folded + i * lanes);
    for (int j = step; j < lanes; j += step) sum = hn::Add(sum, hn::Load(block, folded + i * lanes + j));
    hn::StoreU(sum, block, sums + i * step);
  }
#endif
}

}  // namespace HWY_NAMESPACE
}  // namespace metaekf::linalg
HWY_AFTER_NAMESPACE();

#endif
