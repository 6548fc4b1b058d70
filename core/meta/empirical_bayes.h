#pragma once

#include <vector>

#include "absl/status/statusor.h"
#include "core/meta/outer_loop.h"

namespace metaekf::meta {

/// Name of a value that the state has once a prior is being learned.
inline constexpr char kPriorHasBegun[] = "round";

struct LearnedPrior {
  std::vector<double> parameters;  ///< ω₀
  nssm::GaussianPrior prior;
};

/// Learns ω ~ N(ω₀, Λ⁻¹) over a fleet by expectation–maximisation with Laplace's approximation.
///
///   E: ω_s = argmin ½ Σ r²/σ² + ½ (ω − ω₀)ᵀ Λ (ω − ω₀),   P_s = (Λ + JᵀJ/σ²)⁻¹       for every system s
///   M: ω₀ = mean of ω_s,   C = mean of (ω_s − ω₀)(ω_s − ω₀)ᵀ + P_s,   σ² = median of the residuals' variance
///
/// Λ⁻¹ is C, or the most likely covariance of the structure that the specification asks for (StructuredCovariance).
/// The first ω₀ is the best of several fits of one system, each from a start of its own, or `shared`. Systems whose fit has stalled,
/// recognised by residuals far above the others', do not count in the M-step and begin the next round from the fits of
/// others. Held-out systems judge every round: the best prior is returned.
///
/// @param shared  ω to begin with, of which what does not adapt stays as it is; empty: there is none. Where it has systems' own
///   parameters, they are the first fits, and the first belief is N(mean, spread) of these.
/// Errors: InvalidArgument if that structure has a larger rank than there are parameters; Cancelled if on_step said so;
/// OutOfRange if no start of the first fit simulates its system.
absl::StatusOr<LearnedPrior> LearnGaussianPrior(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask,
                                                const Systems& systems, const LearnedStart& shared, base::Executor* executor,
                                                TrainingState* state, const OnTrainingStep& on_step);

/// What its progress counts up to: outer steps of MAML before it, starts, and fits of `systems` training systems.
int32_t PriorIterations(const GaussianPriorSpec& spec, size_t systems);

}  // namespace metaekf::meta
