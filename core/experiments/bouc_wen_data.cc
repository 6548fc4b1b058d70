#include "core/experiments/bouc_wen_data.h"

#include "core/base/numbers.h"
#include "core/base/status.h"

namespace metaekf::experiments {
namespace {

constexpr uint64_t kTestSeeds = 1 << 20;  // added: tests have phases of their own

sim::Request RequestOf(int64_t systems, int64_t samples, double noise_m, uint64_t seed) {
  sim::Request request{.system = "bouc-wen", .systems = systems, .seed = seed, .steps = samples};
  request.settings["noise_std"] = base::FormatExact(noise_m);
  return request;
}

}  // namespace

absl::StatusOr<sim::Fleet> BoucWenFleet(int64_t systems, int64_t samples, BoucWenExcitation excitation, uint64_t seed,
                                        base::Executor* executor) {
  sim::Request request = RequestOf(systems, samples, kBoucWenNoiseM, seed);
  if (excitation == BoucWenExcitation::kSine) request.settings["excitation"] = "sine";
  return sim::Simulate(request, *executor);
}

absl::StatusOr<BoucWenTargets> RandomBoucWenTargets(int64_t systems, int64_t context_samples, int64_t test_samples,
                                                    uint64_t seed, base::Executor* executor) {
  METAEKF_ASSIGN_OR_RETURN(sim::Fleet contexts,
                           sim::Simulate(RequestOf(systems, context_samples, kBoucWenNoiseM, seed), *executor));
  sim::Request request = RequestOf(systems, test_samples, 0, seed + kTestSeeds);
  request.parameters = contexts.parameters;
  METAEKF_ASSIGN_OR_RETURN(sim::Fleet tests, sim::Simulate(request, *executor));
  return BoucWenTargets{std::move(contexts.dataset.trajectories), std::move(tests.dataset.trajectories)};
}

absl::StatusOr<std::vector<data::Trajectory>> NominalBoucWen(int64_t count, int64_t samples, double noise_m, uint64_t seed,
                                                             base::Executor* executor) {
  sim::Request request = RequestOf(count, samples, noise_m, seed);
  request.settings["nominal"] = "1";
  METAEKF_ASSIGN_OR_RETURN(sim::Fleet fleet, sim::Simulate(request, *executor));
  return std::move(fleet.dataset.trajectories);
}

}  // namespace metaekf::experiments
