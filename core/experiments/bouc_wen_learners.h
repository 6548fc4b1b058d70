#pragma once

#include <vector>

#include "core/experiments/experiment.h"
#include "core/experiments/learner.h"

namespace metaekf::experiments {

inline constexpr char kFromScratchLabel[] = "SSM from scratch";

/// Small networks in double precision: what a fleet of Bouc–Wen oscillators can be learned with here. Those that this build
/// does not know are left out.
std::vector<Learner> BoucWenLearners(Budget budget);

/// MAML with the network that the paper prints, in a fraction of its training.
Learner PrintedMaml(Budget budget);

/// The most probable parameters of a model that knows nothing but the context (meta::FitFromScratch). Architecture and
/// normaliser are those of `bundle`. Errors: those of meta::AdaptedParameters.
absl::StatusOr<SystemModel> FitFromScratch(const nssm::Bundle& bundle, const data::Trajectory& context, uint64_t seed);

/// Trains every learner on the fleet, one after the other with all threads.
/// @param context  of the target, for learners that train on it too.
/// @param seconds  on the wall, of each.
absl::StatusOr<std::vector<nssm::Bundle>> TrainAll(const std::vector<Learner>& learners, const data::Dataset& fleet,
                                                   const data::Trajectory& context, uint64_t seed, base::Executor* executor, const OnProgress& on_progress,
                                                   std::vector<double>* seconds);

}  // namespace metaekf::experiments
