#pragma once

#include <cmath>

#include "core/autodiff/activation.h"

namespace metaekf::autodiff::reference {

// The activations one element at a time, with the standard library's functions: the oracle of the vectorised ones.

template <typename T>
T Sigmoid(T z) {
  return T(1) / (T(1) + std::exp(-z));
}

/// log(1 + eᶻ) without overflow.
template <typename T>
T Softplus(T z) {
  return std::fmax(z, T(0)) + std::log1p(std::exp(-std::fabs(z)));
}

/// Derivatives of the sigmoid s: s' = s(1−s), s'' = s'(1−2s), s''' = s'(1−6s+6s²).
template <typename T>
struct SigmoidJet {
  explicit SigmoidJet(T z) : s(Sigmoid(z)), d1(s * (1 - s)), d2(d1 * (1 - 2 * s)), d3(d1 * (1 - 6 * s + 6 * s * s)) {}
  T s, d1, d2, d3;
};

/// Derivatives of tanh: t' = 1−t², t'' = −2t t', t''' = t'(6t²−2).
template <typename T>
struct TanhJet {
  explicit TanhJet(T z) : t(std::tanh(z)), d1(1 - t * t), d2(-2 * t * d1), d3(d1 * (6 * t * t - 2)) {}
  T t, d1, d2, d3;
};

template <int order, typename T>
T Elu(T z, T alpha) {
  if (z >= 0) return order == 0 ? z : order == 1 ? T(1) : T(0);
  return order == 0 ? alpha * std::expm1(z) : alpha * std::exp(z);
}

template <int order, typename T>
T Tanh(T z) {
  const TanhJet<T> t(z);
  return order == 0 ? t.t : order == 1 ? t.d1 : order == 2 ? t.d2 : t.d3;
}

/// z s(z): the n-th derivative is z s^(n) + n s^(n−1).
template <int order, typename T>
T Swish(T z) {
  const SigmoidJet<T> s(z);
  return order == 0   ? z * s.s
         : order == 1 ? z * s.d1 + s.s
         : order == 2 ? z * s.d2 + 2 * s.d1
                      : z * s.d3 + 3 * s.d2;
}

/// The derivatives of softplus are those of the sigmoid, one order lower.
template <int order, typename T>
T SoftplusDerivative(T z) {
  if (order == 0) return Softplus(z);
  const SigmoidJet<T> s(z);
  return order == 1 ? s.s : order == 2 ? s.d1 : s.d2;
}

/// z m(z) with m = tanh ∘ softplus; m's derivatives by the chain rule (Faà di Bruno).
template <int order, typename T>
T Mish(T z) {
  const TanhJet<T> t(Softplus(z));
  if (order == 0) return z * t.t;
  const SigmoidJet<T> s(z);
  const T m1 = t.d1 * s.s;
  if (order == 1) return z * m1 + t.t;
  const T m2 = t.d2 * s.s * s.s + t.d1 * s.d1;
  if (order == 2) return z * m2 + 2 * m1;
  const T m3 = t.d3 * s.s * s.s * s.s + 3 * t.d2 * s.s * s.d1 + t.d1 * s.d2;
  return z * m3 + 3 * m2;
}

template <int order, typename T>
T Apply(Activation activation, T a, T z) {
  constexpr T kConstant = order == 1 ? T(1) : T(0);  // derivatives of the identity
  switch (activation) {
    case Activation::kRelu:
      return z >= 0 ? (order == 0 ? z : kConstant) : T(0);
    case Activation::kLeakyRelu:
      return (z >= 0 ? T(1) : a) * (order == 0 ? z : kConstant);
    case Activation::kElu:
      return Elu<order>(z, a);
    case Activation::kSelu:
      return T(kSeluLambda) * Elu<order>(z, T(kSeluAlpha));
    case Activation::kTanh:
      return Tanh<order>(z);
    case Activation::kSwish:
      return Swish<order>(z);
    case Activation::kMish:
      return Mish<order>(z);
    case Activation::kSoftplus:
      return SoftplusDerivative<order>(z);
    case Activation::kSine:
      return order == 0 ? std::sin(z) : order == 1 ? std::cos(z) : order == 2 ? -std::sin(z) : -std::cos(z);
    case Activation::kSigmoid: {
      const SigmoidJet<T> s(z);
      return order == 0 ? s.s : order == 1 ? s.d1 : order == 2 ? s.d2 : s.d3;
    }
    case Activation::kTanhSlope:
      return order == 0 ? 1 - z * z : order == 1 ? -2 * z : order == 2 ? T(-2) : T(0);
    default:
      return order == 0 ? z : kConstant;
  }
}

template <typename T>
T Apply(Activation activation, int order, T a, T z) {
  switch (order) {
    case 0:
      return Apply<0>(activation, a, z);
    case 1:
      return Apply<1>(activation, a, z);
    case 2:
      return Apply<2>(activation, a, z);
    default:
      return Apply<3>(activation, a, z);
  }
}

}  // namespace metaekf::autodiff::reference
