#pragma once

#include "core/experiments/experiment.h"

namespace metaekf::experiments {

/// Meta-learning against supervised and transfer learning on van der Pol oscillators (paper.tex fig:baselines).
Experiment VanDerPolComparison();

/// The paper's tables of the Bouc–Wen benchmark, one step ahead and in free run (paper.tex tab:bw_results, tab:bw_benchmarks).
Experiment BoucWenTables();

/// Which layers of the network should adapt, against the amount of data (paper.tex fig:anil).
Experiment AnilHeatmap();

/// How good models of new Bouc–Wen oscillators are, against the length of their contexts. Beyond the paper.
Experiment FewShotCurve();

/// Vehicles that find their position by an unknown magnetic field (paper.tex sec. localization).
Experiment Localization();

/// Refrigeration cycles whose pressures fall along the flow (paper.tex sec. vapor compression).
Experiment VaporCompressionStudy();

/// Whether bounds of all of these systems hold what they say. Beyond the paper.
Experiment Calibration();

}  // namespace metaekf::experiments
