#pragma once

#include "core/experiments/experiment.h"

namespace metaekf::experiments {

/// Meta-learning against supervised and transfer learning on van der Pol oscillators (paper.tex fig:baselines).
Experiment VanDerPolComparison();

/// How good models of new Bouc–Wen oscillators are, against the length of their contexts. Beyond the paper.
Experiment FewShotCurve();

}  // namespace metaekf::experiments
