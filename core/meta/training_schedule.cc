#include "core/meta/training_schedule.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "core/nssm/loss.h"

namespace metaekf::meta {
namespace {

/// Along half a cosine from `start` to `end` while `step` goes from 0 to steps − 1.
double CosineDecay(double start, double end, int32_t step, int32_t steps) {
  const double share = steps > 1 ? static_cast<double>(step) / (steps - 1) : 1;
  return end + (start - end) * 0.5 * (1 + std::cos(std::numbers::pi * share));
}

}  // namespace

double LearningRate(const TrainingSpec& spec, int32_t iteration) {
  const int32_t warmup = spec.warmup_iterations;
  return iteration < warmup
             ? CosineDecay(spec.warmup_lr, spec.outer_lr, iteration, warmup)
             : CosineDecay(spec.outer_lr, spec.final_outer_lr, iteration - warmup, spec.iterations - warmup);
}

int32_t HorizonOf(const TrainingSpec& spec, int32_t iteration) {
  const int32_t shorter_set = std::min(spec.context_samples, spec.target_samples);
  const int32_t full = spec.loss.horizon == nssm::LossSpec::kWholeSet
                           ? nssm::ShapeOfLoss(spec.model, spec.loss, shorter_set)->horizon
                           : spec.loss.horizon;
  const int32_t first = std::min(spec.warmup_horizon, full), step = iteration - spec.warmup_iterations;
  if (step < 0) return first;
  if (step >= spec.horizon_growth_iterations) return full;
  const int32_t lengths = static_cast<int32_t>(std::ceil(std::log2(static_cast<double>(full) / first)));
  if (lengths == 0) return full;
  return first << (int64_t{step} * lengths / spec.horizon_growth_iterations);
}

TrainingSpec SpecOf(const TrainingSpec& spec, int32_t iteration) {
  TrainingSpec own = spec;
  if (iteration < spec.warmup_iterations) own.algorithm = Algorithm::kSupervised;
  if (HorizonOf(spec, iteration) != HorizonOf(spec, spec.iterations)) {
    own.loss.horizon = HorizonOf(spec, iteration);
    // One rollout after the other, as many samples as the one of a whole set has.
    if (spec.loss.horizon == nssm::LossSpec::kWholeSet) own.loss.stride = own.loss.horizon;
  }
  return own;
}

}  // namespace metaekf::meta
