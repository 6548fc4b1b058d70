#pragma once

#include <Eigen/Core>
#include <vector>

#include "absl/status/statusor.h"
#include "core/data/trajectory.h"

namespace metaekf::data {

/// Per channel of one signal: normalised = (physical − mean) / scale. Units: the channel's own.
struct ChannelScaling {
  Eigen::VectorXd mean;
  Eigen::VectorXd scale;  ///< positive

  /// Columns are samples; rows are channels, as many as `mean` has. NaN stays NaN.
  Eigen::MatrixXd Normalise(const Eigen::MatrixXd& physical) const;
  Eigen::MatrixXd Denormalise(const Eigen::MatrixXd& normalised) const;
};

/// What stands between physical units, outside a model, and its own.
struct Normaliser {
  ChannelScaling inputs, outputs, states;
};

/// Channels, counted from 0, that share one scale (each keeps its mean).
///
/// A field y = ∇φ(p) is free of curl in physical units if and only if it is in normalised ones only
/// where all components of y share a scale and all components of p do: then the two Jacobians
/// differ by a number, else by two diagonal matrices, which break their symmetry.
struct ScaleGroup {
  std::vector<Eigen::Index> inputs, outputs, states;
};

/// Mean and standard deviation (divided by the number of values) of every channel over all samples
/// of all trajectories; NaN outputs are left out. The scale of a group is the root of its channels'
/// mean squared deviation, each from its own mean and each counted by its values. A channel or
/// group that does not vary beyond rounding has scale 1.
///
/// Errors: InvalidArgument if there is no sample, a trajectory has other channels than the dataset,
/// a value is infinite or an input or state NaN, an output was never measured, or a group names a
/// channel that does not exist or stands in a group already.
absl::StatusOr<Normaliser> FitNormaliser(const Dataset& dataset,
                                         const std::vector<ScaleGroup>& groups = {});

/// `trajectory` with all signals normalised, or back in physical units.
/// Errors: InvalidArgument if a signal has not as many channels as the normaliser.
absl::StatusOr<Trajectory> Normalised(const Normaliser& normaliser, const Trajectory& trajectory);
absl::StatusOr<Trajectory> Denormalised(const Normaliser& normaliser, const Trajectory& trajectory);

}  // namespace metaekf::data
