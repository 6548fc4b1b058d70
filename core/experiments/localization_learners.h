#pragma once

#include <string>
#include <vector>

#include "core/experiments/experiment.h"
#include "core/experiments/learner.h"

namespace metaekf::experiments {

inline constexpr char kMamlSwish[] = "MAML, swish", kMamlTanh[] = "MAML, tanh", kMamlFree[] = "MAML, swish, field not curl-free",
                      kPriorSwish[] = "Gaussian prior, swish", kPriorFree[] = "Gaussian prior, swish, field not curl-free";

/// What the study of localization trains: MAML, FO-MAML and Reptile with swish and tanh, the learned prior, and what the constraint
/// buys, all of small networks; then, in a full study, the networks that the paper prints, whose labels end so, in a fraction of their
/// training.
std::vector<Learner> LocalizationLearners(Budget budget);

/// The label of the printed network.
std::string Printed(const std::string& label);

}  // namespace metaekf::experiments
