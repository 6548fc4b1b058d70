#pragma once

#include <Eigen/Core>
#include <limits>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/rng.h"
#include "core/data/trajectory.h"
#include "core/sim/signal.h"

namespace metaekf::sim {

/// A physical parameter: drawn uniformly from [min, max] for each system unless it is fixed.
struct Parameter {
  std::string name;
  std::string unit;  ///< empty for a number
  double min = 0;
  double max = 0;
  double nominal = 0;  ///< of the system that the literature takes as the target
  std::string description;
};

/// What else can be chosen: a word among `choices` or, where there are none, a number in [min,
/// max].
struct Option {
  std::string name;
  std::string unit;
  std::string default_value;
  std::string description;
  std::vector<std::string> choices;
  double min = -std::numeric_limits<double>::infinity();
  double max = std::numeric_limits<double>::infinity();
  bool whole = false;  ///< a whole number
};

/// An input that was recorded elsewhere, for every system of a fleet.
struct RecordedInput {
  Eigen::MatrixXd values;      ///< n_u × T, in the input's units
  double sample_period_s = 0;  ///< 0: the system's own
  Hold hold = Hold::kBandLimited;
};

struct System;

/// The settings of one run, checked against a system's parameters and options.
class Settings {
 public:
  /// Takes NAME → VALUE as the user wrote them.
  ///
  /// Errors: InvalidArgument if the system has neither a parameter nor an option of that name (the
  /// message lists those that it has), or the value is no number, no choice, not whole or out of
  /// range.
  static absl::StatusOr<Settings> Check(const System& system,
                                        const std::map<std::string, std::string>& values);

  /// The value of parameter `index` if it is fixed.
  std::optional<double> FixedParameter(size_t index) const { return parameters_[index]; }
  /// Whether the user gave a value for this option.
  bool IsSet(const std::string& option) const { return set_.contains(option); }
  /// The value of a numeric option, or of one that is a choice. The option must exist.
  double Number(const std::string& option) const;
  const std::string& Choice(const std::string& option) const;

 private:
  std::vector<std::optional<double>> parameters_;
  std::map<std::string, std::string> options_;  // every option's value
  std::map<std::string, std::string> set_;
};

/// What one system of a fleet is simulated with.
struct Run {
  std::vector<double> parameters;  ///< in the order of System::parameters
  const Settings& settings;
  std::optional<Eigen::Index> steps;  ///< length to record; without it, the system's own choice
  const RecordedInput* input = nullptr;
};

/// A family of similar systems: what can be chosen, and how one of them is simulated.
struct System {
  std::string name;
  std::string description;
  double sample_period_s = 0;
  std::string default_length;  ///< how many samples are recorded where nobody says, in words
  std::vector<std::string> input_names, output_names, state_names;
  std::vector<Parameter> parameters;
  std::vector<Option> options;

  /// Simulates one system; everything random comes from `rng`. The trajectory has no rows of states
  /// where they are hidden. Errors: InvalidArgument for a run that the system cannot make (see
  /// there), or one that diverges.
  absl::StatusOr<data::Trajectory> (*simulate)(const Run& run, base::Rng& rng) = nullptr;
};

/// How many samples of its recorded input a run of a system takes whose inputs are held from sample to sample: all unless it says.
/// Errors: InvalidArgument if the input is held otherwise, or shorter.
absl::StatusOr<Eigen::Index> StepsOfHeldInput(const Run& run);

/// The option of every system that takes all parameters from their nominal values.
Option NominalOption();
/// The option of every system that adds white noise to its outputs.
Option NoiseOption(const std::string& unit, const std::string& description);
/// Adds that noise: independent normal deviates of the standard deviation that is set.
void AddOutputNoise(const Settings& settings, base::Rng& rng, data::Trajectory& trajectory);

/// InvalidArgument if a state of the trajectory is not finite, with its time.
absl::Status CheckStayedFinite(const data::Trajectory& trajectory);

}  // namespace metaekf::sim
