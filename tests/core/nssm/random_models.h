#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "core/nssm/loss.h"

namespace metaekf::nssm {

/// A model and loss of each kind there is, small enough for finite differences.
struct ModelCase {
  std::string name;
  ModelSpec model;
  LossSpec loss;
  bool smooth = true;  ///< false: the gradient jumps, and with it what an inner step does
};

std::vector<ModelCase> ModelCases();

/// Standard normal signals: nothing that the derivatives could be lucky with.
data::Trajectory RandomTrajectory(const ModelSpec& spec, int64_t length, uint64_t seed);

/// Initial parameters, moved off every special value (zero biases, L = 0.98 I).
std::vector<double> RandomParameters(const Model& model, uint64_t seed);

}  // namespace metaekf::nssm
