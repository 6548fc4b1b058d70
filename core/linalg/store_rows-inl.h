// Included once for each instruction set.
#if defined(METAEKF_STORE_ROWS_INL) == defined(HWY_TARGET_TOGGLE)
#ifdef METAEKF_STORE_ROWS_INL
#undef METAEKF_STORE_ROWS_INL
#else
#define METAEKF_STORE_ROWS_INL
#endif

#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace metaekf::linalg {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// c = v or addend + v in the first `rows` lanes, rows > 0: in the largest pieces that fit, since to copy some elements by way of memory
/// takes longer than to compute them.
template <bool kAdd, class D, typename T = hn::TFromD<D>>
HWY_INLINE void StoreRows(D d, hn::Vec<D> v, int rows, const T* addend, T* c) {
  const int lanes = static_cast<int>(hn::Lanes(d));
  if (rows >= lanes) {
    hn::StoreU(kAdd ? hn::Add(hn::LoadU(d, addend), v) : v, d, c);
    return;
  }
#if HWY_TARGET != HWY_SCALAR
  if constexpr (hn::MaxLanes(D()) > 1) {
    const hn::Half<D> half;
    const int width = lanes / 2;
    StoreRows<kAdd>(half, hn::LowerHalf(half, v), rows, addend, c);
    if (rows > width) StoreRows<kAdd>(half, hn::UpperHalf(half, v), rows - width, addend + width, c + width);
  }
#endif
}

}  // namespace HWY_NAMESPACE
}  // namespace metaekf::linalg
HWY_AFTER_NAMESPACE();

#endif
