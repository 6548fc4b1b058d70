#pragma once

#include <vector>

#include "core/meta/training_spec.h"
#include "core/nssm/loss.h"

namespace metaekf::meta {

/// ω_m = ω_{m−1} − β ∇L(𝓒; ω_{m−1}) for the adapted parameters; the others stay (eqs. maml_inner, anil_inner).
///
/// @param iterates  (m + 1) · n_ω elements, ω_0 in the first n_ω; the rest is written.
/// @param gradient  n_ω elements of scratch.
template <typename T>
void RunInnerLoop(const nssm::LossFunction<T>& context_loss, const nssm::LossData<T>& context, int32_t steps,
                  double learning_rate, int64_t size, T* iterates, T* gradient,
                  const typename nssm::LossFunction<T>::Scratch& scratch);

/// The gradient of one task's target loss after the inner loop, with respect to the parameters before it.
///
///   g = ∇L(𝓣; ω_M),   then for m = M … 1:   g ← g − β H(𝓒; ω_{m−1}) P g         MAML, exact
///   g = ∇L(𝓣; ω_M)                                                          first order
///   g = ∇L(𝓣; ω_0)                                                          supervised
///
/// with P the projection onto the adapted parameters: step m is ω_m = ω_{m−1} − β P ∇L, whose transposed Jacobian
/// is I − β H P. Every parameter has a meta-gradient; only the adapted ones move in the inner loop.
/// Source: paper.tex eqs. maml_inner, maml_outer, anil_inner.
template <typename T>
class MetaGradient {
 public:
  /// @param steps, learning_rate  of the inner loop.
  MetaGradient(const nssm::Model& model, const nssm::LossSpec& loss, Algorithm algorithm,
               const nssm::LossShape& context, const nssm::LossShape& target, const nn::Mask& adapted, int32_t steps,
               double learning_rate);

  /// Memory of one thread: M + 1 parameter vectors, and one step's activations.
  class Scratch {
   public:
    explicit Scratch(const MetaGradient& owner);

   private:
    friend class MetaGradient;
    std::vector<T> iterates_, product_, masked_;
    typename nssm::LossFunction<T>::Scratch inner_, outer_, target_;
  };

  /// @param gradient  n_ω elements, all written. @return L(𝓣; ω_M).
  double Compute(const T* parameters, const nssm::LossData<T>& context, const nssm::LossData<T>& target, T* gradient,
                 Scratch* scratch) const;
  /// L(𝓣; ω_M) alone.
  double TargetLoss(const T* parameters, const nssm::LossData<T>& context, const nssm::LossData<T>& target,
                    Scratch* scratch) const;

 private:
  int32_t InnerSteps() const { return algorithm_ == Algorithm::kSupervised ? 0 : steps_; }
  /// @return ω_M.
  const T* Adapt(const T* parameters, const nssm::LossData<T>& context, Scratch* scratch) const;

  Algorithm algorithm_;
  int32_t steps_;
  double learning_rate_;
  int64_t size_;
  std::vector<std::pair<int64_t, int64_t>> frozen_;  // offset and size of what does not adapt
  nssm::LossFunction<T> inner_;   // on the context set, adapted parameters only
  nssm::LossFunction<T> outer_;   // on the context set, all rows of H P
  nssm::LossFunction<T> target_;  // on the target set, all parameters
};

}  // namespace metaekf::meta
