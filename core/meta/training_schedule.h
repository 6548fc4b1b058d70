#pragma once

#include "core/meta/training_spec.h"

namespace metaekf::meta {

/// The outer learning rate: half a cosine over the warm-up, and another over the rest.
double LearningRate(const TrainingSpec& spec, int32_t iteration);

/// Steps of the longest rollouts that an iteration has: short in the warm-up, then doubling at even distances while they grow,
/// of whole sets up to the length of the shorter set.
int32_t HorizonOf(const TrainingSpec& spec, int32_t iteration);

/// What an iteration trains by. The warm-up is a training of its own: supervised.
TrainingSpec SpecOf(const TrainingSpec& spec, int32_t iteration);

}  // namespace metaekf::meta
