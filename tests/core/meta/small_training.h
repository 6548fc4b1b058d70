#pragma once

#include <string>
#include <utility>

#include "core/base/rng.h"
#include "core/data/trajectory.h"
#include "core/meta/training_spec.h"

namespace metaekf::meta {

/// x⁺ = x + 0.1 (−a x + u), y = x with a drawn per system: what adapts is one number.
inline data::Dataset Fleet(size_t systems, int64_t length, uint64_t seed) {
  data::Dataset fleet{.input_names = {"u1"}, .output_names = {"y1"}, .state_names = {"x1"}};
  for (size_t s = 0; s < systems; ++s) {
    base::Rng rng(seed, s);
    const double a = rng.Uniform(0.5, 4);
    data::Trajectory t{.name = std::to_string(s), .sample_period_s = 0.1};
    t.inputs.resize(1, length);
    t.states.resize(1, length);
    double x = rng.Normal();
    for (Eigen::Index k = 0; k < length; ++k) {
      t.inputs(0, k) = rng.Normal();
      t.states(0, k) = x;
      x += 0.1 * (-a * x + t.inputs(0, k));
    }
    t.outputs = t.states;
    fleet.trajectories.push_back(std::move(t));
  }
  return fleet;
}

/// A training of that fleet that takes a second.
inline TrainingSpec SmallSpec() {
  TrainingSpec spec;
  spec.model.kind = nssm::Case::kStateInputOutput;
  spec.model.latent_size = 3;
  spec.model.window = 1;
  spec.model.transition.bypass = nssm::Bypass::kSkip;
  spec.model.transition.block.hidden_widths = {4};
  spec.model.precision = nssm::Precision::kFloat64;
  spec.loss = {.horizon = 5, .rollout = nssm::RolloutMode::kState, .stride = 5};
  spec.inner_loop = spec.adaptation = {.steps = 3, .learning_rate = 0.02, .adapted_mask = "transition"};
  spec.context_samples = spec.target_samples = 40;
  spec.task_batch = 4;
  spec.iterations = 30;
  spec.warmup_iterations = 10;
  spec.warmup_horizon = 2;
  spec.validation_period = 10;
  spec.outer_lr = spec.final_outer_lr = spec.warmup_lr = 0.01;
  spec.seed = 5;
  return spec;
}

}  // namespace metaekf::meta
