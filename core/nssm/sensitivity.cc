#include "core/nssm/sensitivity.h"

#include <algorithm>

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/nssm/sensitivity.cc"
#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_AVX3_DL)  // little gain over their neighbours, long to compile
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace metaekf::nssm {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// As PropagateSensitivity for n = N, whose factors stay in registers. `target` may be `direct`.
template <size_t N>
void Propagate(size_t size, const double* sensitivity, const double* factors, const double* direct, double* target) {
  const hn::ScalableTag<double> d;
  const size_t lanes = hn::Lanes(d);
  size_t k = 0;
  for (; k + lanes <= size; k += lanes) {
    auto sum = hn::LoadU(d, direct + k);
    for (size_t i = 0; i < N; ++i) {
      sum = hn::MulAdd(hn::Set(d, factors[i]), hn::LoadU(d, sensitivity + i * size + k), sum);
    }
    hn::StoreU(sum, d, target + k);
  }
  for (; k < size; ++k) {
    double sum = direct[k];
    for (size_t i = 0; i < N; ++i) sum += factors[i] * sensitivity[i * size + k];
    target[k] = sum;
  }
}

void PropagateAny(size_t size, size_t n, const double* sensitivity, const double* factors, const double* direct,
                  double* target) {
  constexpr size_t kMost = 8;
  if (n == 0) std::copy_n(direct, size, target);
  while (n > 0) {
    const size_t count = std::min(n, kMost);
    switch (count) {
      case 1: Propagate<1>(size, sensitivity, factors, direct, target); break;
      case 2: Propagate<2>(size, sensitivity, factors, direct, target); break;
      case 3: Propagate<3>(size, sensitivity, factors, direct, target); break;
      case 4: Propagate<4>(size, sensitivity, factors, direct, target); break;
      case 5: Propagate<5>(size, sensitivity, factors, direct, target); break;
      case 6: Propagate<6>(size, sensitivity, factors, direct, target); break;
      case 7: Propagate<7>(size, sensitivity, factors, direct, target); break;
      default: Propagate<8>(size, sensitivity, factors, direct, target); break;
    }
    n -= count;
    sensitivity += count * size;
    factors += count;
    direct = target;
  }
}

}  // namespace HWY_NAMESPACE
}  // namespace metaekf::nssm
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace metaekf::nssm {

HWY_EXPORT(PropagateAny);

void PropagateSensitivity(size_t size, size_t n, const double* sensitivity, const double* factors, const double* direct,
                          double* target) {
  HWY_DYNAMIC_DISPATCH(PropagateAny)(size, n, sensitivity, factors, direct, target);
}

}  // namespace metaekf::nssm
#endif  // HWY_ONCE
