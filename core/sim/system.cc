#include "core/sim/system.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <utility>

#include "absl/strings/str_join.h"
#include "core/base/numbers.h"
#include "core/base/status.h"

namespace metaekf::sim {
namespace {

template <typename Named>
std::string Names(const std::vector<Named>& named) {
  return absl::StrJoin(named, ", ", [](std::string* out, const Named& one) { *out += one.name; });
}

template <typename Named>
auto FindByName(const std::vector<Named>& named, const std::string& name) {
  return std::find_if(named.begin(), named.end(),
                      [&name](const Named& one) { return one.name == name; });
}

absl::StatusOr<double> FiniteNumber(const std::string& name, const std::string& value) {
  const std::optional<double> number = base::ParseDouble(value);
  if (!number || !std::isfinite(*number)) {
    return absl::InvalidArgumentError(absl::StrCat(name, "=", value, ": a number is needed"));
  }
  return *number;
}

absl::Status CheckOption(const Option& option, const std::string& value) {
  if (!option.choices.empty()) {
    const auto& choices = option.choices;
    if (std::find(choices.begin(), choices.end(), value) != choices.end()) return absl::OkStatus();
    return absl::InvalidArgumentError(
        absl::StrCat(option.name, "=", value, " is none of ", absl::StrJoin(choices, ", ")));
  }
  METAEKF_ASSIGN_OR_RETURN(const double number, FiniteNumber(option.name, value));
  if (number < option.min || number > option.max) {
    return absl::InvalidArgumentError(absl::StrCat(option.name, "=", value, " is not between ",
                                                   base::FormatShort(option.min), " and ",
                                                   base::FormatShort(option.max)));
  }
  if (option.whole && number != std::round(number)) {
    return absl::InvalidArgumentError(
        absl::StrCat(option.name, "=", value, ": a whole number is needed"));
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<Settings> Settings::Check(const System& system,
                                         const std::map<std::string, std::string>& values) {
  Settings settings;
  settings.parameters_.resize(system.parameters.size());
  for (const Option& option : system.options) {
    settings.options_[option.name] = option.default_value;
  }
  for (const auto& [name, value] : values) {
    const auto parameter = FindByName(system.parameters, name);
    if (parameter != system.parameters.end()) {
      METAEKF_ASSIGN_OR_RETURN(settings.parameters_[parameter - system.parameters.begin()],
                               FiniteNumber(name, value));
      continue;
    }
    const auto option = FindByName(system.options, name);
    if (option == system.options.end()) {
      return absl::InvalidArgumentError(
          absl::StrCat(system.name, " has no \"", name, "\"; its parameters are ",
                       Names(system.parameters), "; its options ", Names(system.options)));
    }
    METAEKF_RETURN_IF_ERROR(CheckOption(*option, value));
    settings.options_[name] = value;
    settings.set_[name] = value;
  }
  return settings;
}

double Settings::Number(const std::string& option) const {
  const std::optional<double> number = base::ParseDouble(Choice(option));
  assert(number.has_value());
  return *number;
}

const std::string& Settings::Choice(const std::string& option) const {
  const auto found = options_.find(option);
  assert(found != options_.end());
  return found->second;
}

absl::StatusOr<Eigen::Index> StepsOfHeldInput(const Run& run) {
  if (run.input->hold != Hold::kZero) {
    return absl::InvalidArgumentError("inputs of this system are held from sample to sample: use the hold \"zero\"");
  }
  const Eigen::Index recorded = run.input->values.cols(), steps = run.steps.value_or(recorded);
  if (steps > recorded) {
    return absl::InvalidArgumentError(absl::StrCat("the recorded input has ", recorded, " samples, ", steps, " are asked for"));
  }
  return steps;
}

Option NominalOption() {
  return {.name = "nominal",
          .default_value = "0",
          .description = "1: nominal parameters for every system instead of random ones",
          .choices = {"0", "1"}};
}

Option NoiseOption(const std::string& unit, const std::string& description) {
  return {.name = "noise_std",
          .unit = unit,
          .default_value = "0",
          .description = description,
          .min = 0};
}

void AddOutputNoise(const Settings& settings, base::Rng& rng, data::Trajectory& trajectory) {
  const double noise_std = settings.Number("noise_std");
  if (noise_std == 0) return;
  for (double& value : trajectory.outputs.reshaped()) value += noise_std * rng.Normal();
}

absl::Status CheckStayedFinite(const data::Trajectory& trajectory) {
  for (Eigen::Index t = 0; t < trajectory.states.cols(); ++t) {
    if (trajectory.states.col(t).allFinite()) continue;
    const double time_s = static_cast<double>(t) * trajectory.sample_period_s;
    return absl::InvalidArgumentError(
        absl::StrCat("the simulation diverges before ", base::FormatShort(time_s), " s"));
  }
  return absl::OkStatus();
}

}  // namespace metaekf::sim
