#include "tests/benchmark/ceilings.h"

#include <algorithm>
#include <chrono>
#include <vector>

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "tests/benchmark/ceilings.cc"
#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_AVX3_DL)  // as where the code is
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace metaekf::benchmark {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

/// Twelve chains of multiply-adds, more than latency and two units a cycle need. @return operations done.
template <typename T>
double MultiplyAdds(int64_t rounds, T* result) {
  constexpr int kChains = 12;
  const hn::ScalableTag<T> d;
  hn::Vec<decltype(d)> sums[kChains];
  for (int j = 0; j < kChains; ++j) sums[j] = hn::Set(d, static_cast<T>(j));
  const auto factor = hn::Set(d, *result), addend = hn::Set(d, static_cast<T>(1e-3));
  for (int64_t i = 0; i < rounds; ++i) {
    for (int j = 0; j < kChains; ++j) sums[j] = hn::MulAdd(sums[j], factor, addend);
  }
  auto all = sums[0];
  for (int j = 1; j < kChains; ++j) all = hn::Add(all, sums[j]);
  *result = hn::GetLane(all);
  return 2.0 * kChains * static_cast<double>(hn::Lanes(d)) * static_cast<double>(rounds);
}

double FloatMultiplyAdds(int64_t rounds, float* result) { return MultiplyAdds(rounds, result); }
double DoubleMultiplyAdds(int64_t rounds, double* result) { return MultiplyAdds(rounds, result); }

float ReadAll(const float* data, int64_t size) {
  const hn::ScalableTag<float> d;
  const int64_t lanes = static_cast<int64_t>(hn::Lanes(d));
  auto a = hn::Zero(d), b = a, c = a, e = a;
  for (int64_t i = 0; i + 4 * lanes <= size; i += 4 * lanes) {
    a = hn::Add(a, hn::LoadU(d, data + i));
    b = hn::Add(b, hn::LoadU(d, data + i + lanes));
    c = hn::Add(c, hn::LoadU(d, data + i + 2 * lanes));
    e = hn::Add(e, hn::LoadU(d, data + i + 3 * lanes));
  }
  return hn::GetLane(hn::Add(hn::Add(a, b), hn::Add(c, e)));
}

}  // namespace HWY_NAMESPACE
}  // namespace metaekf::benchmark
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace metaekf::benchmark {

HWY_EXPORT(FloatMultiplyAdds);
HWY_EXPORT(DoubleMultiplyAdds);
HWY_EXPORT(ReadAll);

namespace {

using std::chrono::steady_clock;

double SecondsSince(steady_clock::time_point begin) { return std::chrono::duration<double>(steady_clock::now() - begin).count(); }

/// The best of a few: a ceiling is what was reached once.
template <typename Work>
double BestRate(const Work& work) {
  double best = 0;
  for (int i = 0; i < 8; ++i) {
    const steady_clock::time_point begin = steady_clock::now();
    const double amount = work();
    best = std::max(best, amount / SecondsSince(begin));
  }
  return best;
}

double Bandwidth(int64_t bytes) {
  const std::vector<float> data(static_cast<size_t>(bytes) / sizeof(float), 1.0f);
  const int64_t repeats = std::max<int64_t>(1, (int64_t{1} << 27) / bytes);
  volatile float sink = 0;
  return BestRate([&] {
    for (int64_t r = 0; r < repeats; ++r) sink = sink + HWY_DYNAMIC_DISPATCH(ReadAll)(data.data(), static_cast<int64_t>(data.size()));
    return static_cast<double>(bytes * repeats);
  });
}

}  // namespace

Ceilings::Ceilings() {
  constexpr int64_t kRounds = 4'000'000;
  float float_result = 0.999f;
  double double_result = 0.999;
  float_operations_ = BestRate([&] { return HWY_DYNAMIC_DISPATCH(FloatMultiplyAdds)(kRounds, &float_result); });
  double_operations_ = BestRate([&] { return HWY_DYNAMIC_DISPATCH(DoubleMultiplyAdds)(kRounds, &double_result); });
  // About what a core's first and second cache hold, and what the cores share.
  const int64_t sizes[kLevels] = {int64_t{24} << 10, int64_t{384} << 10, int64_t{8} << 20};
  for (int i = 0; i < kLevels; ++i) levels_[i] = {sizes[i], Bandwidth(sizes[i])};
}

const Ceilings& Ceilings::Measured() {
  static const Ceilings ceilings;
  return ceilings;
}

double Ceilings::bandwidth(int64_t working_set) const {
  for (const Level& level : levels_) {
    if (working_set <= level.bytes) return level.bandwidth;
  }
  return levels_[kLevels - 1].bandwidth;
}

}  // namespace metaekf::benchmark
#endif  // HWY_ONCE
