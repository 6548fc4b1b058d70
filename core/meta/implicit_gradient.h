#pragma once

#include <vector>

#include "absl/functional/function_ref.h"
#include "core/meta/inner_loop.h"

namespace metaekf::meta {

/// The derivative of a function of a regularised minimum with respect to what the minimum depends on.
///
/// With a the parameters that adapt, f the others and φ = argmin_a L(𝓒; a, f) + ½ λ |a − a₀|², stationarity
///
///   ∇ₐL(𝓒; φ, f) + λ (φ − a₀) = 0     gives     dφ/da₀ = (I + Hₐₐ/λ)⁻¹,   dφ/df = −(I + Hₐₐ/λ)⁻¹ Hₐf / λ,
///
/// H the Hessian of L(𝓒) at (φ, f). So a function with gradient t = (tₐ, t_f) there has, as a function of (a₀, f), the
/// gradient
///
///   z = (I + Hₐₐ/λ)⁻¹ tₐ   in a₀,      t_f − H_fa z / λ   in f.
///
/// z comes from conjugate gradients, one Hessian–vector product a step, from z = 0. Where the loss is not convex
/// I + Hₐₐ/λ may be indefinite or nearly singular, and short of a minimum that says nothing: the first direction d with
/// dᵀ(I + Hₐₐ/λ)d ≤ 0.1 dᵀd ends the iteration with what there is, and if it is the first of all with z = tₐ, the
/// first-order gradient. λ → ∞ gives t.
///
/// Source: A. Rajeswaran, C. Finn, S. Kakade, S. Levine, Meta-Learning with Implicit Gradients, 2019, for z; the part
/// of f is ours.
template <typename T>
class ImplicitGradient {
 public:
  /// @param proximal  λ, positive.
  ImplicitGradient(const nn::ParameterLayout& layout, const nn::Mask& adapted, double proximal,
                   const ImplicitMamlSpec& solver);

  /// Memory of one thread: four vectors.
  class Scratch {
   public:
    /// @param needed  false: nothing is allocated, nor may Apply be called with it.
    explicit Scratch(const ImplicitGradient& owner, bool needed = true);

   private:
    friend class ImplicitGradient;
    std::vector<T> solution_, residual_, direction_, product_;
  };

  /// @param hessian_vector  writes H v, all rows, for v that is zero in f.
  /// @param gradient        n_ω elements: t, on return the gradient above. Safe to call concurrently; allocates nothing.
  void Apply(absl::FunctionRef<void(const T* v, T* product)> hessian_vector, T* gradient, Scratch* scratch) const;

 private:
  void ClearFrozen(std::vector<T>* vector) const;

  size_t size_;
  nn::Pieces frozen_;
  double proximal_;
  ImplicitMamlSpec solver_;
};

}  // namespace metaekf::meta
