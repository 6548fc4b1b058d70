// The activations in vectors, with the instruction set chosen at run time. Formulas: see activation.h; derivatives:
//   sigmoid s: s' = s(1−s), s'' = s'(1−2s), s''' = s'(1−6s+6s²)
//   tanh t:    t' = 1−t², t'' = −2t t', t''' = t'(6t²−2)
//   swish      n-th derivative z s⁽ⁿ⁾ + n s⁽ⁿ⁻¹⁾
//   sine       sin, cos, −sin, −cos
//   mish       z m with m = tanh ∘ softplus: z m⁽ⁿ⁾ + n m⁽ⁿ⁻¹⁾, m⁽ⁿ⁾ by Faà di Bruno

#include <algorithm>
#include <cstddef>

#include "core/autodiff/activation.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/autodiff/activation_simd.cc"
#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_AVX3_DL)  // little gain over their neighbours, long to compile
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <hwy/contrib/math/math-inl.h>

HWY_BEFORE_NAMESPACE();
namespace metaekf::autodiff {
namespace HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

template <class D>
using V = hn::Vec<D>;

template <class D>
V<D> Const(D d, double value) {
  return hn::Set(d, static_cast<hn::TFromD<D>>(value));
}

/// 1 / (1 + e^{−z}); the argument of the exponential is capped where the result is 0 in any precision.
template <class D>
V<D> Sigmoid(D d, V<D> z) {
  const double cap = sizeof(hn::TFromD<D>) == 4 ? 87.0 : 708.0;
  const V<D> one = Const(d, 1);
  return hn::Div(one, hn::Add(one, hn::Exp(d, hn::Min(hn::Neg(z), Const(d, cap)))));
}

/// log(1 + eᶻ) = max(z, 0) + log(1 + e^{−|z|}).
template <class D>
V<D> Softplus(D d, V<D> z) {
  return hn::Add(hn::Max(z, hn::Zero(d)), hn::Log1p(d, hn::Exp(d, hn::Neg(hn::Abs(z)))));
}

/// s^(order), order ≥ 1, from s.
template <int order, class D>
V<D> SigmoidDerivative(D d, V<D> s) {
  const V<D> one = Const(d, 1);
  const V<D> d1 = hn::Mul(s, hn::Sub(one, s));
  if constexpr (order == 1) return d1;
  if constexpr (order == 2) return hn::Mul(d1, hn::NegMulAdd(Const(d, 2), s, one));
  return hn::Mul(d1, hn::MulAdd(hn::Mul(Const(d, 6), s), hn::Sub(s, one), one));
}

/// t^(order), order ≥ 1, from t = tanh.
template <int order, class D>
V<D> TanhDerivative(D d, V<D> t) {
  const V<D> d1 = hn::NegMulAdd(t, t, Const(d, 1));
  if constexpr (order == 1) return d1;
  if constexpr (order == 2) return hn::Mul(hn::Mul(Const(d, -2), t), d1);
  return hn::Mul(d1, hn::MulSub(hn::Mul(Const(d, 6), t), t, Const(d, 2)));
}

struct Relu {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D>) {
    return hn::IfThenElseZero(hn::Ge(z, hn::Zero(d)), order == 0 ? z : Const(d, order == 1 ? 1 : 0));
  }
};

struct LeakyRelu {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D> slope) {
    const V<D> one = Const(d, 1);
    const V<D> factor = hn::IfThenElse(hn::Ge(z, hn::Zero(d)), one, slope);
    return hn::Mul(factor, order == 0 ? z : Const(d, order == 1 ? 1 : 0));
  }
};

struct Elu {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D> alpha) {
    const V<D> bounded = hn::Min(z, hn::Zero(d));  // eᶻ of what is not used may not overflow
    const V<D> below = hn::Mul(alpha, order == 0 ? hn::Expm1(d, bounded) : hn::Exp(d, bounded));
    return hn::IfThenElse(hn::Ge(z, hn::Zero(d)), order == 0 ? z : Const(d, order == 1 ? 1 : 0), below);
  }
};

struct Selu {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D>) {
    return hn::Mul(Const(d, kSeluLambda), Elu::Apply<order>(d, z, Const(d, kSeluAlpha)));
  }
};

struct TanhFunction {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D>) {
    const V<D> t = hn::Tanh(d, z);
    if constexpr (order == 0) return t;
    return TanhDerivative<order>(d, t);
  }
};

struct Swish {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D>) {
    const V<D> s = Sigmoid(d, z);
    if constexpr (order == 0) return hn::Mul(z, s);
    if constexpr (order == 1) return hn::MulAdd(z, SigmoidDerivative<1>(d, s), s);
    return hn::MulAdd(z, SigmoidDerivative<order>(d, s), hn::Mul(Const(d, order), SigmoidDerivative<order - 1>(d, s)));
  }
};

struct SoftplusFunction {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D>) {
    if constexpr (order == 0) return Softplus(d, z);
    const V<D> s = Sigmoid(d, z);
    if constexpr (order == 1) return s;
    return SigmoidDerivative<order - 1>(d, s);
  }
};

struct Mish {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D>) {
    const V<D> t = hn::Tanh(d, Softplus(d, z));
    if constexpr (order == 0) return hn::Mul(z, t);
    const V<D> s = Sigmoid(d, z), t1 = TanhDerivative<1>(d, t);
    const V<D> m1 = hn::Mul(t1, s);
    if constexpr (order == 1) return hn::MulAdd(z, m1, t);
    const V<D> s1 = SigmoidDerivative<1>(d, s), t2 = TanhDerivative<2>(d, t);
    const V<D> m2 = hn::MulAdd(hn::Mul(t2, s), s, hn::Mul(t1, s1));
    if constexpr (order == 2) return hn::MulAdd(z, m2, hn::Mul(Const(d, 2), m1));
    const V<D> s2 = SigmoidDerivative<2>(d, s), t3 = TanhDerivative<3>(d, t);
    const V<D> cubic = hn::Mul(hn::Mul(t3, s), hn::Mul(s, s));
    const V<D> m3 = hn::Add(hn::MulAdd(hn::Mul(Const(d, 3), t2), hn::Mul(s, s1), cubic), hn::Mul(t1, s2));
    return hn::MulAdd(z, m3, hn::Mul(Const(d, 3), m2));
  }
};

struct Sine {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D>) {
    const V<D> value = order % 2 == 0 ? hn::Sin(d, z) : hn::Cos(d, z);
    return order < 2 ? value : hn::Neg(value);
  }
};

/// The tail is computed by the same instructions in a padded vector, so a result does not depend on where in the
/// array an element stands.
template <class Function, int order, typename T>
void Map(T a, const T* HWY_RESTRICT z, T* out, size_t count) {
  const hn::ScalableTag<T> d;
  const size_t lanes = hn::Lanes(d);
  const V<decltype(d)> parameter = hn::Set(d, a);
  size_t i = 0;
  for (; i + lanes <= count; i += lanes) {
    hn::StoreU(Function::template Apply<order>(d, hn::LoadU(d, z + i), parameter), d, out + i);
  }
  const size_t tail = count - i;
  if (tail == 0) return;
  HWY_ALIGN T padded[HWY_MAX_BYTES / sizeof(T)] = {};
  std::copy_n(z + i, tail, padded);
  hn::Store(Function::template Apply<order>(d, hn::Load(d, padded), parameter), d, padded);
  std::copy_n(padded, tail, out + i);
}

template <class Function, typename T>
void MapOrder(int order, T a, const T* z, T* out, size_t count) {
  switch (order) {
    case 0:
      return Map<Function, 0>(a, z, out, count);
    case 1:
      return Map<Function, 1>(a, z, out, count);
    case 2:
      return Map<Function, 2>(a, z, out, count);
    default:
      return Map<Function, 3>(a, z, out, count);
  }
}

template <typename T>
void ApplyTo(Activation activation, int order, T a, const T* z, T* out, size_t count) {
  switch (activation) {
    case Activation::kIdentity:
      for (size_t i = 0; i < count; ++i) out[i] = order == 0 ? z[i] : order == 1 ? T(1) : T(0);
      return;
    case Activation::kRelu:
      return MapOrder<Relu>(order, a, z, out, count);
    case Activation::kLeakyRelu:
      return MapOrder<LeakyRelu>(order, a, z, out, count);
    case Activation::kElu:
      return MapOrder<Elu>(order, a, z, out, count);
    case Activation::kSelu:
      return MapOrder<Selu>(order, a, z, out, count);
    case Activation::kTanh:
      return MapOrder<TanhFunction>(order, a, z, out, count);
    case Activation::kSwish:
      return MapOrder<Swish>(order, a, z, out, count);
    case Activation::kMish:
      return MapOrder<Mish>(order, a, z, out, count);
    case Activation::kSoftplus:
      return MapOrder<SoftplusFunction>(order, a, z, out, count);
    case Activation::kSine:
      return MapOrder<Sine>(order, a, z, out, count);
  }
}

void ApplyFloat(Activation activation, int order, float a, const float* z, float* out, size_t count) {
  ApplyTo(activation, order, a, z, out, count);
}
void ApplyDouble(Activation activation, int order, double a, const double* z, double* out, size_t count) {
  ApplyTo(activation, order, a, z, out, count);
}

}  // namespace HWY_NAMESPACE
}  // namespace metaekf::autodiff
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace metaekf::autodiff {

HWY_EXPORT(ApplyFloat);
HWY_EXPORT(ApplyDouble);

template <>
void ApplyActivation(Activation activation, int order, float a, const float* z, float* out, size_t count) {
  HWY_DYNAMIC_DISPATCH(ApplyFloat)(activation, order, a, z, out, count);
}

template <>
void ApplyActivation(Activation activation, int order, double a, const double* z, double* out, size_t count) {
  HWY_DYNAMIC_DISPATCH(ApplyDouble)(activation, order, a, z, out, count);
}

}  // namespace metaekf::autodiff
#endif  // HWY_ONCE
