#pragma once

#include <vector>

#include "core/experiments/experiment.h"
#include "core/experiments/learner.h"

namespace metaekf::experiments {

inline constexpr char kFromScratchLabel[] = "SSM from scratch", kByGradientsLabel[] = "SSM from scratch, gradient steps";

/// Small networks in double precision: what a fleet of Bouc–Wen oscillators can be learned with here. The first is the Gaussian
/// prior, the second MAML.
std::vector<Learner> BoucWenLearners(Budget budget);

/// MAML with the network that the paper prints, in a fraction of its training.
Learner PrintedMaml(Budget budget);

/// A model that knows nothing but the context, fitted as `metaekf adapt --method from-scratch` does it: exactly (label
/// kFromScratchLabel) where the start is fitted, else by gradient steps (kByGradientsLabel), both stopped early.
///
/// @param like  the learner whose architecture and loss it has.
/// Errors: those of meta::FitFromScratch or meta::Adapt.
absl::StatusOr<SystemModel> FitFromScratch(const Learner& like, const data::Trajectory& context, uint64_t seed);

}  // namespace metaekf::experiments
