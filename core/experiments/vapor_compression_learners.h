#pragma once

#include <string>
#include <vector>

#include "core/experiments/learner.h"

namespace metaekf::experiments {

/// Labels of vapor-compression learners that findings and figures name.
inline constexpr char kVaporMaml[] = "MAML", kVaporUniversal[] = "one model for all",
                      kVaporTold[] = "one model for all, told the pipe length";
/// The same without the order of pressures in the model. @param label  of the constrained one.
std::string Unconstrained(const std::string& label);

/// Learners of the fleet; the last, kVaporTold, of recordings with the pipe's length as a third input: what could be gained by
/// knowing the system.
std::vector<Learner> VaporCompressionLearners(Budget budget);

/// −1 and 1 where the pressure of the next volume stands below that of this: G x ≤ 0, 7 × 24, row by row.
std::vector<double> PressureOrder();

}  // namespace metaekf::experiments
