#pragma once

#include <Eigen/Geometry>
#include <cmath>
#include <string>

#include "core/base/rng.h"
#include "core/data/trajectory.h"

namespace metaekf::meta {

/// A damped resonator of unknown frequency and damping, bent a little, x measured only through y = x₁ + noise.
/// @param clean  its outputs without noise, unless nullptr.
inline data::Trajectory Resonator(int64_t length, double noise, base::Rng rng, base::Rng of_noise, Eigen::MatrixXd* clean) {
  const double angle = rng.Uniform(0.3, 0.5), radius = rng.Uniform(0.9, 0.95);
  const Eigen::Rotation2D<double> rotation(angle);
  data::Trajectory t{.name = "resonator", .sample_period_s = 0.1};
  t.inputs.resize(1, length);
  t.outputs.resize(1, length);
  t.states.resize(0, length);
  Eigen::Vector2d x = Eigen::Vector2d::Zero();
  for (Eigen::Index k = 0; k < length; ++k) {
    t.inputs(0, k) = rng.Normal();
    x = radius * (rotation * x);
    x[0] += t.inputs(0, k);
    x[1] -= 0.2 * std::tanh(x[0]);
    t.outputs(0, k) = x[0];
  }
  if (clean != nullptr) *clean = t.outputs;
  for (Eigen::Index k = 0; k < length; ++k) t.outputs(0, k) += noise * of_noise.Normal();
  return t;
}

inline data::Trajectory Resonator(int64_t length, double noise, uint64_t seed, Eigen::MatrixXd* clean) {
  return Resonator(length, noise, base::Rng(seed), base::Rng(seed, 1), clean);
}

/// Several of them, named by their number.
inline data::Dataset ResonatorFleet(size_t systems, int64_t length, double noise, uint64_t seed) {
  data::Dataset fleet{.input_names = {"u1"}, .output_names = {"y1"}};
  for (size_t s = 0; s < systems; ++s) {
    fleet.trajectories.push_back(Resonator(length, noise, base::Rng(seed, 2 * s), base::Rng(seed, 2 * s + 1), nullptr));
    fleet.trajectories.back().name = std::to_string(s);
  }
  return fleet;
}

}  // namespace metaekf::meta
