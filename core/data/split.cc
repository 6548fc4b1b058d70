#include "core/data/split.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "core/base/rng.h"

namespace metaekf::data {
namespace {

Trajectory Columns(const Trajectory& trajectory, Eigen::Index first, Eigen::Index count) {
  Trajectory part;
  part.name = trajectory.name;
  part.start_s = trajectory.start_s + static_cast<double>(first) * trajectory.sample_period_s;
  part.sample_period_s = trajectory.sample_period_s;
  part.inputs = trajectory.inputs.middleCols(first, count);
  part.outputs = trajectory.outputs.middleCols(first, count);
  part.states = trajectory.states.middleCols(first, count);
  return part;
}

absl::Status OutsideError(const Trajectory& trajectory, Eigen::Index asked) {
  return absl::OutOfRangeError(absl::StrCat("trajectory ", trajectory.name, " has ",
                                            trajectory.length(), " samples; ", asked,
                                            " were asked for"));
}

}  // namespace

absl::StatusOr<Split> SplitSystems(size_t count, double validation_share, uint64_t seed) {
  if (count == 0) return absl::InvalidArgumentError("there is no system to split");
  if (!(validation_share >= 0 && validation_share < 1)) {
    return absl::InvalidArgumentError(
        absl::StrCat("validation share ", validation_share, " must be at least 0 and below 1"));
  }
  if (validation_share > 0 && count == 1) {
    return absl::InvalidArgumentError(
        "one system cannot be split; give more systems, or a validation share of 0");
  }
  size_t held_out = 0;
  if (validation_share > 0) {
    const double wanted = std::round(validation_share * static_cast<double>(count));
    held_out = std::clamp<size_t>(static_cast<size_t>(wanted), 1, count - 1);
  }
  std::vector<size_t> order(count);
  std::iota(order.begin(), order.end(), size_t{0});
  base::Rng rng(seed);
  for (size_t i = count - 1; i > 0; --i) std::swap(order[i], order[rng.Index(i + 1)]);
  Split split;
  split.validation.assign(order.begin(), order.begin() + static_cast<std::ptrdiff_t>(held_out));
  split.training.assign(order.begin() + static_cast<std::ptrdiff_t>(held_out), order.end());
  std::sort(split.validation.begin(), split.validation.end());
  std::sort(split.training.begin(), split.training.end());
  return split;
}

absl::StatusOr<Dataset> Subset(const Dataset& dataset, const std::vector<size_t>& indices) {
  Dataset subset{dataset.input_names, dataset.output_names, dataset.state_names, {}};
  for (const size_t index : indices) {
    if (index >= dataset.trajectories.size()) {
      return absl::OutOfRangeError(
          absl::StrCat("trajectory ", index, " was asked for, of ", dataset.trajectories.size()));
    }
    subset.trajectories.push_back(dataset.trajectories[index]);
  }
  return subset;
}

absl::StatusOr<Trajectory> FirstSamples(const Trajectory& trajectory, Eigen::Index count) {
  if (count < 0 || count > trajectory.length()) return OutsideError(trajectory, count);
  return Columns(trajectory, 0, count);
}

absl::StatusOr<Trajectory> SamplesFrom(const Trajectory& trajectory, Eigen::Index first) {
  if (first < 0 || first > trajectory.length()) return OutsideError(trajectory, first);
  return Columns(trajectory, first, trajectory.length() - first);
}

}  // namespace metaekf::data
