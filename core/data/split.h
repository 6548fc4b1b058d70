#pragma once

#include <cstdint>
#include <vector>

#include "absl/status/statusor.h"
#include "core/data/trajectory.h"

namespace metaekf::data {

/// Indices of trajectories, ascending.
struct Split {
  std::vector<size_t> training;
  std::vector<size_t> validation;
};

/// Splits `count` systems at random: whole systems, since samples of one system tell about each
/// other.
///
/// The number held out is validation_share · count, rounded, but at least one if the share is
/// positive and at least one stays for training. The same arguments give the same split.
///
/// Errors: InvalidArgument unless count ≥ 1 and 0 ≤ validation_share < 1, or if the share is
/// positive and there is only one system.
absl::StatusOr<Split> SplitSystems(size_t count, double validation_share, uint64_t seed);

/// The trajectories at `indices`, in that order. Errors: OutOfRange for an index beyond the last.
absl::StatusOr<Dataset> Subset(const Dataset& dataset, const std::vector<size_t>& indices);

/// Samples 0 … count−1 of a trajectory. Errors: OutOfRange unless 0 ≤ count ≤ length.
absl::StatusOr<Trajectory> FirstSamples(const Trajectory& trajectory, Eigen::Index count);

/// Sample `first` and all after it; start_s moves along. Errors: OutOfRange unless 0 ≤ first ≤
/// length.
absl::StatusOr<Trajectory> SamplesFrom(const Trajectory& trajectory, Eigen::Index first);

}  // namespace metaekf::data
