#pragma once

#include <cstdint>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/executor.h"
#include "core/data/trajectory.h"
#include "core/sim/simulate.h"

namespace metaekf::experiments {

/// Of the benchmark's estimation signal, in m.
inline constexpr double kBoucWenNoiseM = 7.5e-6;

enum class BoucWenExcitation {
  kMultisine,  ///< random phases, 5–150 Hz, 50 N RMS: the benchmark's band
  kSine,       ///< 120 sin 2πt N: as the paper prints it
};

/// Oscillators of the paper's parameter box, with noise on y.
absl::StatusOr<sim::Fleet> BoucWenFleet(int64_t systems, int64_t samples, BoucWenExcitation excitation, uint64_t seed,
                                        base::Executor* executor);

/// Systems to be learned, and what their models are tested with: the same systems under other multisines, without noise.
struct BoucWenTargets {
  std::vector<data::Trajectory> contexts, tests;
};
absl::StatusOr<BoucWenTargets> RandomBoucWenTargets(int64_t systems, int64_t context_samples, int64_t test_samples,
                                                    uint64_t seed, base::Executor* executor);

/// `count` responses of the nominal system to multisines; the noise may be 0.
absl::StatusOr<std::vector<data::Trajectory>> NominalBoucWen(int64_t count, int64_t samples, double noise_m, uint64_t seed,
                                                             base::Executor* executor);

}  // namespace metaekf::experiments
