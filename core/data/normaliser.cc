#include "core/data/normaliser.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <string>
#include <tuple>

#include "absl/status/status.h"
#include "core/base/status.h"

namespace metaekf::data {
namespace {

/// What one channel's values amount to.
struct Moments {
  double count = 0;
  double mean = 0;
  double squared_deviations = 0;  // summed, from the mean
  double magnitude = 0;           // largest absolute value
  bool grouped = false;
};

using Signal = Eigen::MatrixXd Trajectory::*;

absl::Status CheckChannels(const Dataset& dataset, Signal signal,
                           const std::vector<std::string>& names) {
  for (const Trajectory& trajectory : dataset.trajectories) {
    const Eigen::MatrixXd& values = trajectory.*signal;
    if (values.rows() == static_cast<Eigen::Index>(names.size()) &&
        values.cols() == trajectory.length()) {
      continue;
    }
    return absl::InvalidArgumentError(absl::StrCat(
        "trajectory ", trajectory.name, " holds a signal of ", values.rows(), " × ", values.cols(),
        " values, expected ", names.size(), " × ", trajectory.length()));
  }
  return absl::OkStatus();
}

/// Two passes: the deviations are taken from the final mean, so that a large mean costs no digits.
absl::StatusOr<Moments> MeasureChannel(const Dataset& dataset, Signal signal, Eigen::Index channel,
                                       const std::string& name, bool may_be_missing) {
  Moments moments;
  double sum = 0;
  for (const Trajectory& trajectory : dataset.trajectories) {
    for (Eigen::Index t = 0; t < trajectory.length(); ++t) {
      const double value = (trajectory.*signal)(channel, t);
      if (std::isnan(value) && may_be_missing) continue;
      if (!std::isfinite(value)) {
        return absl::InvalidArgumentError(absl::StrCat("trajectory ", trajectory.name, ", sample ",
                                                       t, ", ", name, ": ", value,
                                                       " where a finite value is needed"));
      }
      sum += value;
      moments.count += 1;
      moments.magnitude = std::max(moments.magnitude, std::abs(value));
    }
  }
  if (moments.count == 0) {
    return absl::InvalidArgumentError(absl::StrCat(name, " has no value in the whole data set"));
  }
  moments.mean = sum / moments.count;
  for (const Trajectory& trajectory : dataset.trajectories) {
    for (Eigen::Index t = 0; t < trajectory.length(); ++t) {
      const double value = (trajectory.*signal)(channel, t);
      if (!std::isnan(value)) moments.squared_deviations += std::pow(value - moments.mean, 2);
    }
  }
  return moments;
}

absl::StatusOr<std::vector<Moments>> MeasureSignal(const Dataset& dataset, Signal signal,
                                                   const std::vector<std::string>& names,
                                                   bool may_be_missing) {
  METAEKF_RETURN_IF_ERROR(CheckChannels(dataset, signal, names));
  std::vector<Moments> channels;
  for (size_t i = 0; i < names.size(); ++i) {
    METAEKF_ASSIGN_OR_RETURN(
        Moments moments,
        MeasureChannel(dataset, signal, static_cast<Eigen::Index>(i), names[i], may_be_missing));
    channels.push_back(moments);
  }
  return channels;
}

absl::Status Collect(const std::vector<Eigen::Index>& group, const char* signal,
                     std::vector<Moments>& channels, std::vector<Moments*>& members) {
  for (const Eigen::Index index : group) {
    if (index < 0 || index >= static_cast<Eigen::Index>(channels.size())) {
      return absl::InvalidArgumentError(
          absl::StrCat("a scale group names ", signal, " ", index, ", of ", channels.size()));
    }
    if (channels[index].grouped) {
      return absl::InvalidArgumentError(absl::StrCat("a scale group names ", signal, " ", index,
                                                     ", which is in a group already"));
    }
    channels[index].grouped = true;
    members.push_back(&channels[index]);
  }
  return absl::OkStatus();
}

/// Gives all members the moments of the whole group, their means aside.
void Pool(const std::vector<Moments*>& members) {
  Moments whole;
  for (const Moments* member : members) {
    whole.count += member->count;
    whole.squared_deviations += member->squared_deviations;
    whole.magnitude = std::max(whole.magnitude, member->magnitude);
  }
  for (Moments* member : members) {
    member->count = whole.count;
    member->squared_deviations = whole.squared_deviations;
    member->magnitude = whole.magnitude;
  }
}

ChannelScaling Scaling(const std::vector<Moments>& channels) {
  const Eigen::Index size = static_cast<Eigen::Index>(channels.size());
  ChannelScaling scaling{Eigen::VectorXd(size), Eigen::VectorXd(size)};
  for (Eigen::Index i = 0; i < size; ++i) {
    const Moments& moments = channels[i];
    const double deviation = std::sqrt(moments.squared_deviations / moments.count);
    scaling.mean[i] = moments.mean;
    scaling.scale[i] = deviation > 1e-12 * moments.magnitude ? deviation : 1.0;
  }
  return scaling;
}

template <typename Map>
absl::StatusOr<Trajectory> MapSignals(const Normaliser& normaliser, const Trajectory& trajectory,
                                      const Map& map) {
  Trajectory mapped;
  mapped.name = trajectory.name;
  mapped.start_s = trajectory.start_s;
  mapped.sample_period_s = trajectory.sample_period_s;
  for (const auto& [scaling, signal, name] :
       {std::tuple{&normaliser.inputs, &Trajectory::inputs, "inputs"},
        std::tuple{&normaliser.outputs, &Trajectory::outputs, "outputs"},
        std::tuple{&normaliser.states, &Trajectory::states, "states"}}) {
    const Eigen::MatrixXd& values = trajectory.*signal;
    if (values.rows() != scaling->mean.size()) {
      return absl::InvalidArgumentError(absl::StrCat("trajectory ", trajectory.name, " has ",
                                                     values.rows(), " ", name, ", the normaliser ",
                                                     scaling->mean.size()));
    }
    mapped.*signal = map(*scaling, values);
  }
  return mapped;
}

}  // namespace

Eigen::MatrixXd ChannelScaling::Normalise(const Eigen::MatrixXd& physical) const {
  assert(physical.rows() == mean.size());
  return ((physical.colwise() - mean).array().colwise() / scale.array()).matrix();
}

Eigen::MatrixXd ChannelScaling::Denormalise(const Eigen::MatrixXd& normalised) const {
  assert(normalised.rows() == mean.size());
  return (normalised.array().colwise() * scale.array()).matrix().colwise() + mean;
}

absl::StatusOr<Normaliser> FitNormaliser(const Dataset& dataset,
                                         const std::vector<ScaleGroup>& groups) {
  const bool any_sample =
      std::any_of(dataset.trajectories.begin(), dataset.trajectories.end(),
                  [](const Trajectory& trajectory) { return trajectory.length() > 0; });
  if (!any_sample) return absl::InvalidArgumentError("no sample to fit a normaliser to");
  METAEKF_ASSIGN_OR_RETURN(std::vector<Moments> inputs,
                           MeasureSignal(dataset, &Trajectory::inputs, dataset.input_names, false));
  METAEKF_ASSIGN_OR_RETURN(
      std::vector<Moments> outputs,
      MeasureSignal(dataset, &Trajectory::outputs, dataset.output_names, true));
  METAEKF_ASSIGN_OR_RETURN(std::vector<Moments> states,
                           MeasureSignal(dataset, &Trajectory::states, dataset.state_names, false));
  for (const ScaleGroup& group : groups) {
    std::vector<Moments*> members;
    METAEKF_RETURN_IF_ERROR(Collect(group.inputs, "input", inputs, members));
    METAEKF_RETURN_IF_ERROR(Collect(group.outputs, "output", outputs, members));
    METAEKF_RETURN_IF_ERROR(Collect(group.states, "state", states, members));
    Pool(members);
  }
  return Normaliser{Scaling(inputs), Scaling(outputs), Scaling(states)};
}

absl::StatusOr<Trajectory> Normalised(const Normaliser& normaliser, const Trajectory& trajectory) {
  return MapSignals(normaliser, trajectory, [](const ChannelScaling& scaling, const auto& values) {
    return scaling.Normalise(values);
  });
}

absl::StatusOr<Trajectory> Denormalised(const Normaliser& normaliser,
                                        const Trajectory& trajectory) {
  return MapSignals(normaliser, trajectory, [](const ChannelScaling& scaling, const auto& values) {
    return scaling.Denormalise(values);
  });
}

}  // namespace metaekf::data
