// The activations in vectors, with the instruction set chosen at run time. Formulas: see activation.h; derivatives:
//   sigmoid s: s' = s(1−s), s'' = s'(1−2s), s''' = s'(1−6s+6s²)
//   tanh t:    t' = 1−t², t'' = −2t t', t''' = t'(6t²−2)
//   swish      n-th derivative z s⁽ⁿ⁾ + n s⁽ⁿ⁻¹⁾
//   sine       sin, cos, −sin, −cos
//   mish       z m with m = tanh ∘ softplus: z m⁽ⁿ⁾ + n m⁽ⁿ⁻¹⁾, m⁽ⁿ⁾ by Faà di Bruno
// In Min and Max z stands second: that is the one handed on if it is no number, and what comes of it must not be one either.

#include <algorithm>
#include <cstddef>

#include "core/autodiff/activation.h"
#include "core/autodiff/kernel.h"

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
  const V<D> s = hn::Div(one, hn::Add(one, hn::Exp(d, hn::Min(hn::Neg(z), Const(d, cap)))));
  return hn::IfThenElse(hn::IsNaN(z), z, s);  // the exponential of no number is zero
}

/// log(1 + eᶻ) = max(z, 0) + log(1 + e^{−|z|}).
template <class D>
V<D> Softplus(D d, V<D> z) {
  return hn::Add(hn::Max(hn::Zero(d), z), hn::Log1p(d, hn::Exp(d, hn::Neg(hn::Abs(z)))));
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
    if constexpr (order == 0) return hn::Max(hn::Zero(d), z);
    return hn::IfThenElseZero(hn::Ge(z, hn::Zero(d)), Const(d, order == 1 ? 1 : 0));
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
    const V<D> bounded = hn::Min(hn::Zero(d), z);  // eᶻ of what is not used may not overflow
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

/// In float z P(z²)/Q(z²), whose coefficients make the largest relative error of the quotient over |z| ≤ 9 smallest, 2.1e-8; with rounding
/// it is below 4e-7. It takes half of the time of one by way of the exponential, for which each step of a recurrence has to wait.
template <class D>
V<D> HyperbolicTangent(D d, V<D> z) {
  if constexpr (sizeof(hn::TFromD<D>) == 8) {
    return hn::Tanh(d, z);
  } else {
    const V<D> one = Const(d, 1), limit = Const(d, 9);
    const V<D> x = hn::Min(limit, hn::Max(hn::Neg(limit), z)), t = hn::Mul(x, x);
    V<D> p = hn::MulAdd(Const(d, 1.331932415e-8), t, Const(d, 2.05836849898e-5));
    V<D> q = hn::MulAdd(Const(d, 7.76212903945e-7), t, Const(d, 3.28311398131e-4));
    p = hn::MulAdd(p, t, Const(d, 3.49404790637e-3));
    q = hn::MulAdd(q, t, Const(d, 2.58711249971e-2));
    p = hn::MulAdd(p, t, Const(d, 0.133797295097));
    q = hn::MulAdd(q, t, Const(d, 0.467130447663));
    p = hn::MulAdd(p, t, one);
    q = hn::MulAdd(q, t, one);
    return hn::Min(one, hn::Max(hn::Neg(one), hn::Div(hn::Mul(x, p), q)));
  }
}

struct TanhFunction {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D>) {
    const V<D> t = HyperbolicTangent(d, z);
    if constexpr (order == 0) return t;
    return TanhDerivative<order>(d, t);
  }
};

struct TanhSlope {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D>) {
    if constexpr (order == 0) return hn::NegMulAdd(z, z, Const(d, 1));
    return order == 1 ? hn::Mul(Const(d, -2), z) : Const(d, order == 2 ? -2 : 0);
  }
};

struct SigmoidFunction {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D>) {
    const V<D> s = Sigmoid(d, z);
    if constexpr (order == 0) return s;
    return SigmoidDerivative<order>(d, s);
  }
};

struct Swish {
  template <int order, class D>
  static V<D> Apply(D d, V<D> z, V<D>) {
    return From<order>(d, z, Sigmoid(d, z));
  }
  /// @param s  the sigmoid of z.
  template <int order, class D>
  static V<D> From(D d, V<D> z, V<D> s) {
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
    const V<D> t = HyperbolicTangent(d, Softplus(d, z));
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

template <typename T>
using MapFunction = void (*)(T a, const T* z, T* out, size_t count);

template <int order, typename T>
void MapIdentity(T, const T* z, T* out, size_t count) {
  for (size_t i = 0; i < count; ++i) out[i] = order == 0 ? z[i] : order == 1 ? T(1) : T(0);
}

/// The map of a function's derivative, for callers; and as a kernel, for programs.
template <typename T>
struct Forms {
  MapFunction<T> map;
  Kernel<T> kernel;
};

template <typename T, MapFunction<T> map>
void MapKernel(const Instruction& i, const Places<T>& at) {
  map(T(i.scalar), at.a, at.out, static_cast<size_t>(int64_t{i.rows} * i.cols));
}

/// Swish, whose second operand is the sigmoid.
template <int order, typename T>
void SwishKernel(const Instruction& i, const Places<T>& at) {
  const hn::ScalableTag<T> d;
  const size_t lanes = hn::Lanes(d), count = static_cast<size_t>(int64_t{i.rows} * i.cols);
  size_t k = 0;
  for (; k + lanes <= count; k += lanes) {
    hn::StoreU(Swish::From<order>(d, hn::LoadU(d, at.a + k), hn::LoadU(d, at.b + k)), d, at.out + k);
  }
  const hn::CappedTag<T, 1> one;
  for (; k < count; ++k) hn::StoreU(Swish::From<order>(one, hn::LoadU(one, at.a + k), hn::LoadU(one, at.b + k)), one, at.out + k);
}

template <class Function, int order, typename T>
constexpr Forms<T> FormsOf() {
  return {Map<Function, order, T>, MapKernel<T, Map<Function, order, T>>};
}
template <int order, typename T>
constexpr Forms<T> FormsOfIdentity() {
  return {MapIdentity<order, T>, MapKernel<T, MapIdentity<order, T>>};
}

template <int order, typename T>
Forms<T> OfOrder(Activation activation) {
  switch (activation) {
    case Activation::kIdentity:
      return FormsOfIdentity<order, T>();
    case Activation::kRelu:
      return FormsOf<Relu, order, T>();
    case Activation::kLeakyRelu:
      return FormsOf<LeakyRelu, order, T>();
    case Activation::kElu:
      return FormsOf<Elu, order, T>();
    case Activation::kSelu:
      return FormsOf<Selu, order, T>();
    case Activation::kTanh:
      return FormsOf<TanhFunction, order, T>();
    case Activation::kSwish:
      return {Map<Swish, order, T>, SwishKernel<order, T>};
    case Activation::kMish:
      return FormsOf<Mish, order, T>();
    case Activation::kSoftplus:
      return FormsOf<SoftplusFunction, order, T>();
    case Activation::kSine:
      return FormsOf<Sine, order, T>();
    case Activation::kSigmoid:
      return FormsOf<SigmoidFunction, order, T>();
    case Activation::kTanhSlope:
      return FormsOf<TanhSlope, order, T>();
  }
  return {};
}

template <typename T>
Forms<T> Select(Activation activation, int order) {
  switch (order) {
    case 0:
      return OfOrder<0, T>(activation);
    case 1:
      return OfOrder<1, T>(activation);
    case 2:
      return OfOrder<2, T>(activation);
    default:
      return OfOrder<3, T>(activation);
  }
}

MapFunction<float> FloatMap(Activation activation, int order) { return Select<float>(activation, order).map; }
MapFunction<double> DoubleMap(Activation activation, int order) { return Select<double>(activation, order).map; }
Kernel<float> FloatKernel(Activation activation, int order) { return Select<float>(activation, order).kernel; }
Kernel<double> DoubleKernel(Activation activation, int order) { return Select<double>(activation, order).kernel; }

}  // namespace HWY_NAMESPACE
}  // namespace metaekf::autodiff
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace metaekf::autodiff {

HWY_EXPORT(FloatMap);
HWY_EXPORT(DoubleMap);
HWY_EXPORT(FloatKernel);
HWY_EXPORT(DoubleKernel);

template <>
void ApplyActivation(Activation activation, int order, float a, const float* z, float* out, size_t count) {
  HWY_DYNAMIC_DISPATCH(FloatMap)(activation, order)(a, z, out, count);
}

template <>
void ApplyActivation(Activation activation, int order, double a, const double* z, double* out, size_t count) {
  HWY_DYNAMIC_DISPATCH(DoubleMap)(activation, order)(a, z, out, count);
}

template <>
Kernel<float> SelectActivationKernel(Activation activation, int order) {
  return HWY_DYNAMIC_DISPATCH(FloatKernel)(activation, order);
}

template <>
Kernel<double> SelectActivationKernel(Activation activation, int order) {
  return HWY_DYNAMIC_DISPATCH(DoubleKernel)(activation, order);
}

}  // namespace metaekf::autodiff
#endif  // HWY_ONCE
