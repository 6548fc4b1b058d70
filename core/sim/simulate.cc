#include "core/sim/simulate.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <mutex>
#include <utility>

#include "absl/strings/str_join.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/sim/bouc_wen.h"
#include "core/sim/magnetic_localization.h"
#include "core/sim/van_der_pol.h"
#include "core/sim/vapor_compression.h"

namespace metaekf::sim {
namespace {

absl::Status CheckTable(const System& system, const Settings& settings, const data::Table& table,
                        int64_t systems) {
  if (table.values.rows() != systems) {
    return absl::InvalidArgumentError(absl::StrCat("the table of parameters has ",
                                                   table.values.rows(), " rows for ", systems,
                                                   " systems; one row per system is needed"));
  }
  for (const std::string& name : table.names) {
    const auto parameter = std::find_if(system.parameters.begin(), system.parameters.end(),
                                        [&name](const Parameter& one) { return one.name == name; });
    if (parameter == system.parameters.end()) {
      return absl::InvalidArgumentError(absl::StrCat("the table of parameters has a column \"",
                                                     name, "\", which is no parameter of ",
                                                     system.name));
    }
    if (settings.FixedParameter(parameter - system.parameters.begin())) {
      return absl::InvalidArgumentError(absl::StrCat(
          name, " is fixed by a setting and stands in the table of parameters too; drop one"));
    }
  }
  return absl::OkStatus();
}

absl::Status CheckInput(const System& system, const RecordedInput& input) {
  const size_t channels = system.input_names.size();
  if (channels == 0) {
    return absl::InvalidArgumentError(absl::StrCat(system.name, " takes no input"));
  }
  if (input.values.rows() != static_cast<Eigen::Index>(channels)) {
    return absl::InvalidArgumentError(absl::StrCat("the recorded input has ", input.values.rows(),
                                                   " channels, ", system.name, " takes ",
                                                   channels));
  }
  if (input.values.cols() == 0) return absl::InvalidArgumentError("the recorded input is empty");
  if (!input.values.allFinite()) {
    return absl::InvalidArgumentError("the recorded input holds a value that is not finite");
  }
  // Printed times carry the period to some digits only.
  const double period_s = input.sample_period_s;
  if (period_s != 0 && std::abs(period_s / system.sample_period_s - 1) > 1e-3) {
    return absl::InvalidArgumentError(absl::StrCat(
        "the recorded input has a sample period of ", base::FormatShort(period_s, 6), " s, ",
        system.name, " of ", base::FormatShort(system.sample_period_s, 6), " s; resample it"));
  }
  return absl::OkStatus();
}

std::vector<double> DrawParameters(const System& system, const Request& request,
                                   const Settings& settings, Eigen::Index index, base::Rng& rng) {
  const bool nominal = settings.Choice("nominal") == "1";
  std::vector<double> values;
  for (const Parameter& parameter : system.parameters) {
    const double drawn = rng.Uniform(parameter.min, parameter.max);
    values.push_back(nominal ? parameter.nominal : drawn);
  }
  for (size_t i = 0; i < values.size(); ++i) {
    if (request.parameters) {
      const std::vector<std::string>& names = request.parameters->names;
      const auto column = std::find(names.begin(), names.end(), system.parameters[i].name);
      if (column != names.end()) {
        values[i] = request.parameters->values(index, column - names.begin());
      }
    }
    values[i] = settings.FixedParameter(i).value_or(values[i]);
  }
  return values;
}

}  // namespace

const std::vector<const System*>& Systems() {
  static const std::vector<const System*> systems = {&VanDerPol(), &BoucWen(), &VaporCompression(),
                                                     &MagneticLocalization()};
  return systems;
}

absl::StatusOr<const System*> FindSystem(const std::string& name) {
  for (const System* system : Systems()) {
    if (system->name == name) return system;
  }
  const auto append_name = [](std::string* out, const System* system) { *out += system->name; };
  return absl::NotFoundError(absl::StrCat("there is no system \"", name, "\"; there are ",
                                          absl::StrJoin(Systems(), ", ", append_name)));
}

absl::Status AddSetting(const std::string& text, std::map<std::string, std::string>& settings) {
  const size_t equals = text.find('=');
  if (equals == std::string::npos || equals == 0) {
    return absl::InvalidArgumentError(absl::StrCat("\"", text, "\" is not of the form NAME=VALUE"));
  }
  const std::string name = text.substr(0, equals);
  if (!settings.emplace(name, text.substr(equals + 1)).second) {
    return absl::InvalidArgumentError(absl::StrCat(name, " is set twice"));
  }
  return absl::OkStatus();
}

absl::StatusOr<Fleet> Simulate(const Request& request, base::Executor& executor, const OnSystem& on_system) {
  METAEKF_ASSIGN_OR_RETURN(const System* const system, FindSystem(request.system));
  METAEKF_ASSIGN_OR_RETURN(const Settings settings, Settings::Check(*system, request.settings));
  if (request.systems < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat(request.systems, " systems were asked for; at least 1 is needed"));
  }
  if (request.steps && *request.steps < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat(*request.steps, " steps were asked for; at least 1 is needed"));
  }
  if (request.parameters) {
    METAEKF_RETURN_IF_ERROR(CheckTable(*system, settings, *request.parameters, request.systems));
  }
  if (request.input) METAEKF_RETURN_IF_ERROR(CheckInput(*system, *request.input));

  const size_t count = static_cast<size_t>(request.systems);
  Fleet fleet;
  fleet.dataset.trajectories.resize(count);
  fleet.parameters.values.resize(request.systems, system->parameters.size());
  std::vector<absl::Status> statuses(count);
  std::mutex telling;
  int64_t done = 0;
  std::atomic<bool> cancelled = false;
  executor.ParallelFor(count, [&](size_t index, size_t) {
    if (cancelled) return;
    const Eigen::Index row = static_cast<Eigen::Index>(index);
    base::Rng rng(request.seed, index);
    Run run{DrawParameters(*system, request, settings, row, rng), settings, request.steps,
            request.input ? &*request.input : nullptr};
    fleet.parameters.values.row(row) =
        Eigen::Map<const Eigen::RowVectorXd>(run.parameters.data(), run.parameters.size());
    absl::StatusOr<data::Trajectory> trajectory = system->simulate(run, rng);
    if (!trajectory.ok()) {
      statuses[index] = base::Annotate(trajectory.status(), absl::StrCat("system ", index));
      return;
    }
    trajectory->name = absl::StrCat(index);
    fleet.dataset.trajectories[index] = *std::move(trajectory);
    const std::lock_guard<std::mutex> lock(telling);
    ++done;
    if (on_system && !on_system(done)) cancelled = true;
  });
  if (cancelled) return absl::CancelledError("the simulation was cancelled");
  for (const absl::Status& status : statuses) METAEKF_RETURN_IF_ERROR(status);

  for (const Parameter& parameter : system->parameters) {
    fleet.parameters.names.push_back(parameter.name);
  }
  fleet.dataset.input_names = system->input_names;
  fleet.dataset.output_names = system->output_names;
  if (fleet.dataset.trajectories.front().states.rows() > 0) {
    fleet.dataset.state_names = system->state_names;
  }
  return fleet;
}

}  // namespace metaekf::sim
