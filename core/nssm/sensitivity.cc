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

/// target = Σ factors S, or added to it, for n = N, whose factors stay in registers.
template <size_t N, bool kAdd>
void Combine(size_t size, const double* sensitivity, const double* factors, double* target) {
  const hn::ScalableTag<double> d;
  const size_t lanes = hn::Lanes(d);
  size_t k = 0;
  for (; k + lanes <= size; k += lanes) {
    auto sum = kAdd ? hn::LoadU(d, target + k) : hn::Zero(d);
    for (size_t i = 0; i < N; ++i) {
      sum = hn::MulAdd(hn::Set(d, factors[i]), hn::LoadU(d, sensitivity + i * size + k), sum);
    }
    hn::StoreU(sum, d, target + k);
  }
  for (; k < size; ++k) {
    double sum = kAdd ? target[k] : 0;
    for (size_t i = 0; i < N; ++i) sum += factors[i] * sensitivity[i * size + k];
    target[k] = sum;
  }
}

template <bool kAdd>
void CombineUpToEight(size_t size, size_t n, const double* sensitivity, const double* factors, double* target) {
  switch (n) {
    case 1: return Combine<1, kAdd>(size, sensitivity, factors, target);
    case 2: return Combine<2, kAdd>(size, sensitivity, factors, target);
    case 3: return Combine<3, kAdd>(size, sensitivity, factors, target);
    case 4: return Combine<4, kAdd>(size, sensitivity, factors, target);
    case 5: return Combine<5, kAdd>(size, sensitivity, factors, target);
    case 6: return Combine<6, kAdd>(size, sensitivity, factors, target);
    case 7: return Combine<7, kAdd>(size, sensitivity, factors, target);
    default: return Combine<8, kAdd>(size, sensitivity, factors, target);
  }
}

/// target += factor · a
void AddScaled(const double* a, size_t size, double factor, double* target) {
  const hn::CappedTag<double, 4> d;  // columns of small networks: wider vectors would mostly leave a rest
  const size_t lanes = hn::Lanes(d);
  const auto factors = hn::Set(d, factor);
  size_t k = 0;
  for (; k + lanes <= size; k += lanes) {
    hn::StoreU(hn::MulAdd(factors, hn::LoadU(d, a + k), hn::LoadU(d, target + k)), d, target + k);
  }
  for (; k < size; ++k) target[k] += factor * a[k];
}

void Propagate(size_t size, size_t n, const double* sensitivity, const double* factors, const DirectTerm* terms,
               size_t count, size_t column, double scale, double* target) {
  constexpr size_t kMost = 8;
  if (n == 0) std::fill_n(target, size, 0.0);
  for (size_t i = 0; i < n; i += kMost) {
    const auto combine = i == 0 ? CombineUpToEight<false> : CombineUpToEight<true>;
    combine(size, std::min(n - i, kMost), sensitivity + i * size, factors + i, target);
  }
  for (size_t term = 0; term < count; ++term) {
    const DirectTerm& t = terms[term];
    const double* a = t.a + column * t.rows;
    for (size_t k = 0; k < t.cols; ++k) {
      const double b = t.b == nullptr ? 1 : t.b[column * t.cols + k];
      AddScaled(a, t.rows, scale * b, target + t.first + k * t.stride);
    }
  }
}

}  // namespace HWY_NAMESPACE
}  // namespace metaekf::nssm
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace metaekf::nssm {

HWY_EXPORT(Propagate);

void PropagateSensitivity(size_t size, size_t n, const double* sensitivity, const double* factors, const DirectTerm* terms,
                          size_t count, size_t column, double scale, double* target) {
  HWY_DYNAMIC_DISPATCH(Propagate)(size, n, sensitivity, factors, terms, count, column, scale, target);
}

}  // namespace metaekf::nssm
#endif  // HWY_ONCE
