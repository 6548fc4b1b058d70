#pragma once

#include <memory>
#include <optional>
#include <vector>

#include "core/meta/implicit_gradient.h"
#include "core/meta/inner_loop.h"
#include "core/meta/proximal_fit.h"
#include "core/meta/training_spec.h"
#include "core/nssm/loss.h"

namespace metaekf::meta {

/// The gradient of one task after the inner loop, with respect to the parameters before it.
///
///   MAML               g = ∇L(𝓣; ω_M), pulled back through the M steps with Hessian–vector products: exact
///   FIRST_ORDER_MAML   g = ∇L(𝓣; ω_M)
///   SUPERVISED         g = ∇L(𝓣; ω_0)
///   IMPLICIT_MAML      g = the gradient of L(𝓣) at the minimum of L(𝓒; ω) + ½ λ |ω − ω₀|², which ω_M is taken for
///                          (ImplicitGradient)
///   REPTILE            g = d_1 + … + d_M of an inner loop on 𝓒 ∪ 𝓣 = (ω₀ − ω_M)/β;  of parameters that do not adapt the
///                          sum of their gradients ∇L(𝓒 ∪ 𝓣; ω_{m−1}) on the way
///
/// With LEVENBERG_MARQUARDT for optimiser IMPLICIT_MAML does not take ω_M for the minimum, it goes there: by FitProximal, in
/// double whatever T, then by Newton steps with the exact Hessian until ∇L + λ (ω − ω₀) is `cg_tolerance` of λ |ω − ω₀|.
///
/// L(𝓒 ∪ 𝓣) is the mean of both losses by the number of samples that each predicts. With one step of gradient descent
/// Reptile's is the plain gradient of L(𝓒 ∪ 𝓣; ω₀), for every parameter.
///
/// Every parameter has a meta-gradient; only the adapted ones move in the inner loop. If rates are learned
/// the variables are ω, then ρ_l = log β_l of every adapted tensor l, and ∂/∂ρ_l = β_l ∂/∂β_l: exact for MAML, for
/// FIRST_ORDER_MAML −β_l ⟨∇L(𝓣; ω_M), d_1 + … + d_M⟩_l, which takes the d_m for constants.
///
/// Source: paper.tex eqs. maml_inner, maml_outer, anil_inner; A. Nichol, J. Achiam, J. Schulman, On First-Order
/// Meta-Learning Algorithms, 2018, for Reptile; Z. Li et al., Meta-SGD, 2017, for the rates, there one per parameter.
template <typename T>
class MetaGradient {
 public:
  /// @param spec  its loss, algorithm, inner_loop and implicit_maml are read.
  MetaGradient(const nssm::Model& model, const TrainingSpec& spec, const nssm::LossShape& context,
               const nssm::LossShape& target, const nn::Mask& adapted);

  /// Memory of one caller: what InnerLoop::Trace holds, and one step's activations; of MAML every step's, where these are not many more
  /// than the parameters.
  class Scratch {
   public:
    /// @param executor  that the gradients of large models run on (nssm::LossFunction); it must outlive the scratch.
    explicit Scratch(const MetaGradient& owner, base::Executor* executor = base::CallingThread());

   private:
    friend class MetaGradient;
    typename InnerLoop<T>::Trace trace_;
    typename ImplicitGradient<T>::Scratch implicit_;
    std::vector<T> target_gradient_;
    std::unique_ptr<nssm::RolloutLeastSquares::Workspace> least_squares_;
    std::vector<T> minimum_, last_, step_;  // of Minimum and Settle
    std::vector<double> rates_, rate_adjoints_;
    std::vector<T> records_;  // of outer_, for every step
    typename nssm::LossFunction<T>::Scratch loss_;
  };

  /// Whether the gradients of the inner loop record what the products at their points need.
  bool records() const { return outer_.record_size() > 0; }
  /// n_ω, and the number of adapted tensors if rates are learned.
  size_t variables() const;

  /// @param gradient  as many elements as variables, all written.
  /// @return L(𝓣; ω_M); of Reptile L(𝓒 ∪ 𝓣; ω_M).
  double Compute(const T* variables, const nssm::LossData<T>& context, const nssm::LossData<T>& target, T* gradient,
                 Scratch* scratch) const;
  /// L(𝓣; ω_M) alone, adapted to 𝓒.
  double TargetLoss(const T* variables, const nssm::LossData<T>& context, const nssm::LossData<T>& target,
                    Scratch* scratch) const;
  /// Of every adapted tensor l the largest eigenvalue, by magnitude, of its block of the Hessian of L(𝓒; ω), by power
  /// iteration: gradient descent on l alone is stable up to a rate of twice its inverse. To about a hundredth, from below.
  std::vector<double> Curvatures(const T* variables, const nssm::LossData<T>& context, Scratch* scratch) const;

 private:
  void ReadRates(const T* variables, Scratch* scratch) const;
  /// argmin L(𝓒; ω) + ½ λ |ω − ω₀|² by Levenberg–Marquardt. @return inside the scratch.
  const T* Minimum(const T* start, const nssm::LossData<T>& context, Scratch* scratch) const;
  /// Newton steps from what least squares have found: their costs do not tell points 1e-8 apart, gradients do.
  void Settle(const T* start, const nssm::LossData<T>& context, Scratch* scratch) const;
  /// @return ω_M.
  const T* Adapt(const T* variables, const nssm::LossData<T>& context, Scratch* scratch) const;
  /// Where outer_ keeps what it has computed in step m, or null.
  T* RecordOf(int32_t m, Scratch* scratch) const;
  double Reptile(const T* variables, const nssm::LossData<T>& context, const nssm::LossData<T>& target, T* gradient,
                 Scratch* scratch) const;
  void PullBack(const nssm::LossData<T>& context, T* gradient, Scratch* scratch) const;
  void WriteRateGradient(T* gradient, Scratch* scratch) const;

  Algorithm algorithm_;
  bool learned_rates_;
  int64_t size_;
  std::vector<double> rates_;  // of the adapted tensors, unless they are learned
  InnerLoop<T> loop_;
  ImplicitGradient<T> implicit_;
  nssm::LossSpec loss_;
  int32_t steps_;
  double proximal_, tolerance_;
  std::optional<nssm::RolloutLeastSquares> least_squares_;  // of Minimum
  nssm::LossFunction<T> inner_;   // on the context set, adapted parameters only
  nssm::LossFunction<T> outer_;   // on the context set, all parameters; all rows of H P
  nssm::LossFunction<T> target_;  // on the target set, all parameters
};

}  // namespace metaekf::meta
