#include "core/sim/simulate.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <thread>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "client/cli/commands.h"
#include "client/cli/data_files.h"
#include "client/cli/progress.h"
#include "core/base/executor.h"
#include "core/base/numbers.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

struct Flags {
  sim::Request request;
  int64_t steps = 0;
  std::vector<std::string> settings;
  std::string parameters, input, inputs, hold = "band-limited", out, parameters_out;
  bool help = false;
};

std::string SystemNames() {
  return absl::StrJoin(sim::Systems(), ", ", [](std::string* out, const sim::System* system) {
    absl::StrAppend(out, system->name);
  });
}

std::string InUnit(const std::string& unit) { return unit.empty() ? "" : " " + unit; }

/// "0|1, " or "at least 0, "; empty if anything goes.
std::string Values(const sim::Option& option) {
  if (!option.choices.empty()) return absl::StrJoin(option.choices, "|") + ", ";
  const std::string whole = option.whole ? "whole, " : "";
  const std::string low = base::FormatShort(option.min), high = base::FormatShort(option.max);
  if (std::isinf(option.min) && std::isinf(option.max)) return whole;
  if (std::isinf(option.max)) return absl::StrCat(whole, "at least ", low, ", ");
  if (std::isinf(option.min)) return absl::StrCat(whole, "at most ", high, ", ");
  return absl::StrCat(whole, low, " to ", high, ", ");
}

/// The choices of one system, for its help.
void PrintSystem(const sim::System& system, std::ostream& out) {
  out << system.name << ": " << system.description << "\n"
      << "  inputs: "
      << (system.input_names.empty() ? "none" : absl::StrJoin(system.input_names, ", "))
      << "; outputs: " << absl::StrJoin(system.output_names, ", ")
      << "; states: " << absl::StrJoin(system.state_names, ", ") << "; sample period "
      << base::FormatShort(system.sample_period_s) << " s; default length " << system.default_length
      << "\nParameters (--set NAME=VALUE fixes one; else drawn from its "
      << "range):\n";
  for (const sim::Parameter& one : system.parameters) {
    out << "  " << one.name << "  " << base::FormatShort(one.min) << " to "
        << base::FormatShort(one.max) << InUnit(one.unit) << ", nominal "
        << base::FormatShort(one.nominal) << "  " << one.description << "\n";
  }
  out << "Options (--set NAME=VALUE):\n";
  for (const sim::Option& one : system.options) {
    out << "  " << one.name << "  " << Values(one) << "default " << one.default_value
        << InUnit(one.unit) << "  " << one.description << "\n";
  }
}

absl::Status PrintHelp(const Flags& flags, const CLI::App& command, Console& console) {
  console.out << command.help("metaekf");
  if (flags.request.system.empty()) return absl::OkStatus();
  const auto system = sim::FindSystem(flags.request.system);
  if (!system.ok()) return UsageError(std::string(system.status().message()));
  console.out << "\n";
  PrintSystem(**system, console.out);
  return absl::OkStatus();
}

/// Turns what was typed into the request. Errors: usage, and of the files.
absl::StatusOr<sim::Request> ToRequest(const Flags& flags) {
  sim::Request request = flags.request;
  if (request.system.empty()) return UsageError("say which system: " + SystemNames());
  if (flags.out.empty()) return UsageError("--out FILE is needed");
  const auto system = sim::FindSystem(request.system);
  if (!system.ok()) return UsageError(std::string(system.status().message()));
  for (const std::string& setting : flags.settings) {
    const absl::Status added = sim::AddSetting(setting, request.settings);
    if (!added.ok()) return UsageError(std::string(added.message()));
  }
  const auto checked = sim::Settings::Check(**system, request.settings);
  if (!checked.ok()) return UsageError(std::string(checked.status().message()));
  if (flags.steps > 0) request.steps = flags.steps;
  if (!flags.parameters.empty()) {
    METAEKF_ASSIGN_OR_RETURN(request.parameters, data::ReadTableFile(flags.parameters));
  }
  if (flags.input.empty()) return request;

  DataFlags columns{.inputs = flags.inputs.empty() ? absl::StrJoin((*system)->input_names, ",")
                                                   : flags.inputs};
  data::CsvOptions options = FreeColumns(columns);
  options.outputs.emplace();
  options.states.emplace();
  METAEKF_ASSIGN_OR_RETURN(const data::Dataset recorded, ReadData({flags.input}, options));
  if (recorded.trajectories.size() != 1) {
    return absl::InvalidArgumentError(
        absl::StrCat(flags.input, " holds several trajectories; the input must be one"));
  }
  const auto hold = sim::ParseHold(flags.hold);
  if (!hold.ok()) return UsageError(std::string(hold.status().message()));
  const data::Trajectory& record = recorded.trajectories.front();
  request.input = {record.inputs, record.sample_period_s, *hold};
  return request;
}

absl::Status WriteParameters(const sim::Fleet& fleet, const std::string& path) {
  std::string text = absl::StrJoin(fleet.parameters.names, ",") + "\n";
  for (const auto& row : fleet.parameters.values.rowwise()) {
    absl::StrAppend(&text,
                    absl::StrJoin(row, ",",
                                  [](std::string* out, double value) {
                                    absl::StrAppend(out, base::FormatExact(value));
                                  }),
                    "\n");
  }
  return WriteFile(path, text);
}

absl::Status Simulate(const Flags& flags, Console& console) {
  METAEKF_ASSIGN_OR_RETURN(const sim::Request request, ToRequest(flags));
  const auto executor = base::MakeThreadExecutor(std::max(1U, std::thread::hardware_concurrency()));
  std::optional<Progress> progress(std::in_place, console, "simulate");
  METAEKF_ASSIGN_OR_RETURN(const sim::Fleet fleet, sim::Simulate(request, *executor, [&](int64_t done) {
    progress->Update(static_cast<uint64_t>(done), static_cast<uint64_t>(request.systems), std::nullopt, "systems");
    return true;
  }));
  progress.reset();
  METAEKF_RETURN_IF_ERROR(data::WriteCsvFile(fleet.dataset, flags.out));
  if (!flags.parameters_out.empty()) {
    METAEKF_RETURN_IF_ERROR(WriteParameters(fleet, flags.parameters_out));
  }
  Eigen::Index samples = 0;
  for (const auto& trajectory : fleet.dataset.trajectories) samples += trajectory.length();
  console.err << "wrote " << flags.out << ": " << fleet.dataset.trajectories.size() << " systems, "
              << samples << " samples\n";
  return absl::OkStatus();
}

}  // namespace

void AddSimulate(CLI::App& app, Console& console, Command& chosen) {
  auto* command =
      app.add_subcommand("simulate", "Draw a family of similar systems and simulate it");
  auto flags = std::make_shared<Flags>();
  // The help of a system needs its name, which the usual flag would not wait for.
  command->set_help_flag();
  command->add_flag("-h,--help", flags->help,
                    "Print this help; with SYSTEM also its parameters and options");
  command->add_option("SYSTEM", flags->request.system, SystemNames());
  command->add_option("--systems", flags->request.systems, "Number of systems (default 1)")
      ->check(CLI::PositiveNumber);
  command->add_option("--seed", flags->request.seed, "Seed of everything random (default 0)");
  command->add_option("--out", flags->out, "CSV file to write");
  command->add_option("--steps", flags->steps, "Samples recorded of each")
      ->check(CLI::PositiveNumber);
  command
      ->add_option("--set", flags->settings,
                   "NAME=VALUE: fixes a system parameter or an option of the excitation; repeat")
      ->allow_extra_args(false);
  command->add_option("--params", flags->parameters, "CSV with one row of parameters per system");
  command->add_option("--params-out", flags->parameters_out,
                      "CSV file for the parameters that were used");
  auto* input = command->add_option("--input", flags->input, "CSV with the input of every system");
  command->add_option("--inputs", flags->inputs, "Columns of the input in that file")->needs(input);
  command
      ->add_option("--hold", flags->hold,
                   "What the input is between samples: band-limited (default), linear or zero")
      ->needs(input);
  OnChosen(command, chosen, [flags, command, &console] {
    return flags->help ? PrintHelp(*flags, *command, console) : Simulate(*flags, console);
  });
}

}  // namespace metaekf::cli
