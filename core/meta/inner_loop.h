#pragma once

#include <utility>
#include <vector>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "core/meta/training_spec.h"
#include "core/nn/parameters.h"

namespace metaekf::meta {

/// β of every tensor of a layout: its own in `tensor_rates`, else `learning_rate`.
std::vector<double> RatesOfTensors(const InnerLoopSpec& spec, const nn::ParameterLayout& layout);
/// Errors: InvalidArgument naming the entry of `tensor_rates` that is no tensor of the layout.
absl::Status CheckTensorRates(const InnerLoopSpec& spec, const nn::ParameterLayout& layout);

/// What a run of the inner loop leaves behind for the meta-gradient.
enum class InnerRecord {
  kResult,  ///< ω_M only
  kTotal,   ///< and the sum of the directions
  kSteps,   ///< every step, so that derivatives can be pulled back through them
};

/// The inner loop of one task, M steps of gradient descent or Adam, and its derivative.
///
///   ω_m = ω_{m−1} − β_l d_m            for the elements of the adapted tensors l; the others stay
///   d_m = g_m = ∇L(ω_{m−1})            gradient descent
///   d_m = m̂_m / (√v̂_m + ε)             Adam: m_m = β₁ m_{m−1} + (1 − β₁) g_m,  v_m = β₂ v_{m−1} + (1 − β₂) g_m²
///
/// With a pull λ it minimises L + ½ λ |ω − ω₀|². Gradient descent takes the pull implicitly, at ω_m, so that no λ
/// makes it unstable: ω_m = ω₀ + (ω_{m−1} − β d_m − ω₀)/(1 + β λ), whose rest is the minimum. Adam adds λ (ω − ω₀) to g.
///
/// Immutable and safe to share; each thread brings a Trace. No call allocates, but for what it takes to
/// hand the steps of a large model to threads.
/// Source: paper.tex eqs. maml_inner, anil_inner; the pull is that of A. Rajeswaran et al., Meta-Learning with Implicit
/// Gradients, 2019, its implicit step ours.
template <typename T>
class InnerLoop {
 public:
  /// @param pull  λ.
  InnerLoop(const nn::ParameterLayout& layout, const nn::Mask& adapted, Optimiser optimiser, int32_t steps, double pull,
            InnerRecord record);

  /// One run: memory of one caller. In elements of ω: kResult holds two vectors, kSteps of gradient descent M + 1 iterates
  /// (and M gradients if rates are learned), of Adam M gradients and 2 M moments more.
  class Trace {
   public:
    /// @param executor  that steps of large models run on; it must outlive the trace.
    explicit Trace(const InnerLoop& owner, bool rates_are_learned = false, base::Executor* executor = base::CallingThread());
    /// d_1 + … + d_M, and of parameters that do not adapt the sum of their gradients. With kTotal.
    const T* total() const { return total_.data(); }

   private:
    friend class InnerLoop;
    T* At(std::vector<T>& vectors, int32_t index) const;

    int64_t size_;
    base::Executor* executor_;
    std::vector<T> iterates_, gradients_, first_, second_, total_;      // one vector, or one per step
    std::vector<T> direction_, product_, first_adjoint_, second_adjoint_;  // of PullBack
  };

  /// Of step m = 1 … M, at ω_{m−1}.
  using Gradient = absl::FunctionRef<void(int32_t m, const T* at, T* gradient)>;
  using HessianVector = absl::FunctionRef<void(int32_t m, const T* at, const T* v, T* product)>;

  /// @param rates  β of every adapted tensor, in the layout's order. @param gradient  writes all elements.
  /// @return ω_M, inside the trace.
  const T* Run(const T* start, const std::vector<double>& rates, Gradient gradient, Trace* trace) const;

  /// Takes the derivative of a function of ω_M to that of the same function of ω₀, exactly, for λ = 0. Backwards:
  ///
  ///   gradient descent   ω̄ ← ω̄ − H P β ω̄                                      H at ω_{m−1}
  ///   Adam               d̄ = −β P ω̄,   s = √v̂
  ///                      m̄ ← m̄ + d̄ / (c₁ (s + ε)),   v̄ ← v̄ − d̄ m̂ / (2 c₂ s (s + ε)²)
  ///                      ω̄ ← ω̄ + H P ((1 − β₁) m̄ + 2 (1 − β₂) g v̄),   m̄ ← β₁ m̄,   v̄ ← β₂ v̄
  ///   either             β̄_l ← β̄_l − ⟨ω̄, d⟩_l   before ω̄ changes
  ///
  /// with P the projection onto what adapts and c₁, c₂ the bias corrections. Where v is 0 every gradient has been 0, and
  /// the term in v̄ is left out: it is multiplied by g = 0. What remains, d̄ / (c₁ ε), is Adam's true slope there, 10⁸.
  ///
  /// @param adjoint       n_ω elements: ω̄ of ω_M, on return that of ω₀.
  /// @param rate_adjoint  β̄ of every adapted tensor, added to; nullptr if rates are not learned.
  void PullBack(const std::vector<double>& rates, HessianVector hessian_vector, Trace* trace, T* adjoint,
                double* rate_adjoint) const;

  /// Tensors that adapt.
  size_t tensors() const { return adapted_.size(); }
  /// Where each is.
  const nn::Pieces& adapted() const { return adapted_; }

 private:
  /// From ω_{m−1} to ω_m, which may be one place.
  void Step(int32_t m, const T* start, const std::vector<double>& rates, const T* from, T* to, Trace* trace) const;
  /// β̄ ← β̄ − ⟨ω̄, d⟩ of step m.
  void AddRateAdjoint(int32_t m, const T* adjoint, Trace* trace, double* rate_adjoint) const;
  /// Writes what H is multiplied by in step m, after the product of step m + 1, or null, is subtracted from ω̄.
  void StepAdjoint(int32_t m, const std::vector<double>& rates, const T* product, T* adjoint, Trace* trace) const;
  static void Subtract(const nn::Pieces& pieces, const T* product, T* adjoint, base::Executor* executor);

  int64_t size_;
  nn::Pieces adapted_, frozen_;
  Optimiser optimiser_;
  int32_t steps_;
  double pull_;
  InnerRecord record_;
};

}  // namespace metaekf::meta
