#pragma once

#include <map>
#include <string>
#include <vector>

#include "core/experiments/learner.h"

namespace metaekf::experiments {

/// Labels of vapor-compression learners that findings and figures name.
inline constexpr char kVaporPrior[] = "mixed effects and prior", kVaporMaml[] = "MAML", kVaporUniversal[] = "one model for all",
                      kVaporTold[] = "one model for all, told the pipe length";
/// The same without the order of pressures in the model. @param label  of the constrained one.
std::string Unconstrained(const std::string& label);

/// Learners of the fleet; the last, kVaporTold, of recordings with the pipe's length as a third input: what could be gained by
/// knowing the system.
std::vector<Learner> VaporCompressionLearners(Budget budget);

/// Of the simulator. What the paper leaves open was settled before any training: inputs are held for 5 s, sensors have noise of 1 kPa and 0.1 K.
std::map<std::string, std::string> VaporCompressionSettings();

/// −1 and 1 where the pressure of the next volume stands below that of this: G x ≤ 0, 7 × 24, row by row.
std::vector<double> PressureOrder();

}  // namespace metaekf::experiments
