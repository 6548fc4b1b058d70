#pragma once

#include <cstddef>
#include <cstdint>

namespace metaekf::autodiff {

/// Elementwise functions σ(z). `a` is the parameter where a function has one.
enum class Activation : uint8_t {
  kIdentity,   // z
  kRelu,       // max(z, 0)
  kLeakyRelu,  // z, z ≥ 0; a z, z < 0
  kElu,        // z, z ≥ 0; a (eᶻ − 1), z < 0
  kSelu,       // λ ELU(z) with a = α
  kTanh,
  kSwish,     // z / (1 + e^{−z})
  kMish,      // z tanh(log(1 + eᶻ))
  kSoftplus,  // log(1 + eᶻ)
  kSine,      // sin z, |z| below 10⁴
  kSigmoid,   // 1 / (1 + e^{−z}), which swish and its derivatives are made of
  kTanhSlope,  // 1 − z²: the slope of tanh where its value is z
};

/// The highest derivative that Apply knows: a curl-free output takes one derivative, its loss's
/// gradient another, the Hessian–vector product a third.
inline constexpr int kMaxDerivative = 3;

/// The constants of Klambauer et al. (2017).
inline constexpr double kSeluLambda = 1.0507009873554804934193349852946;
inline constexpr double kSeluAlpha = 1.6732632423543772848170429916717;

/// Whether σ has continuous derivatives of all orders.
bool IsSmooth(Activation activation);

/// Whether the derivative of this order is zero everywhere (where it exists).
bool DerivativeIsZero(Activation activation, int order);

/// The parameter that a function has by default: `a`, or β of swish, which callers apply themselves (nn::Block); 0 where it has none.
double DefaultParameter(Activation activation);

/// out_i = σ^(order)(z_i), i < count; in place is allowed. At the kink of a piecewise function the
/// derivative is the right one; σ of what is no number is none. order must be 0 … kMaxDerivative. Vectorised for the processor at hand.
template <typename T>
void ApplyActivation(Activation activation, int order, T a, const T* z, T* out, size_t count);

}  // namespace metaekf::autodiff
