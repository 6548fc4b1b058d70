#include <algorithm>
#include <memory>
#include <thread>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "client/cli/commands.h"
#include "client/cli/data_files.h"
#include "client/cli/progress.h"
#include "core/base/executor.h"
#include "core/base/status.h"
#include "core/experiments/experiment.h"

namespace metaekf::cli {
namespace {

struct Flags {
  std::string experiment, budget = "quick", data, out;
  int seeds = 0;
};

std::string Names() {
  return absl::StrJoin(experiments::Experiments(), ", ",
                       [](std::string* out, const experiments::Experiment& one) { absl::StrAppend(out, one.name); });
}

absl::Status Reproduce(const Flags& flags, Console& console) {
  const auto experiment = experiments::FindExperiment(flags.experiment);
  if (!experiment.ok()) return UsageError(std::string(experiment.status().message()));
  experiments::Options options;
  options.budget = flags.budget == "full" ? experiments::Budget::kFull : experiments::Budget::kQuick;
  if (flags.seeds > 0) options.seeds = flags.seeds;
  if (!flags.data.empty()) {
    METAEKF_ASSIGN_OR_RETURN(const data::Dataset recorded, ReadData({flags.data}, FreeColumns({})));
    options.recording = recorded.trajectories.front();
  }
  const std::string directory = flags.out.empty() ? (*experiment)->name : flags.out;
  METAEKF_RETURN_IF_ERROR(experiments::WriteProtocol((*experiment)->protocol(options), directory));
  const auto executor = base::MakeThreadExecutor(std::max(1U, std::thread::hardware_concurrency()));
  experiments::Report report;
  {
    Progress progress(console, flags.experiment);
    METAEKF_ASSIGN_OR_RETURN(
        report, (*experiment)->run(options, executor.get(), [&progress](size_t done, size_t total, const std::string& what) {
          progress.Update(done, total, std::nullopt, what);
          return true;
        }));
  }
  METAEKF_RETURN_IF_ERROR(experiments::WriteReport(report, directory));
  console.out << experiments::ToText(report);
  console.err << "wrote protocol, tables and figures to " << directory << "\n";
  return absl::OkStatus();
}

}  // namespace

void AddReproduce(CLI::App& app, Console& console, Command& chosen) {
  std::string list;
  for (const experiments::Experiment& one : experiments::Experiments()) {
    absl::StrAppend(&list, "\n  ", one.name, ": ", one.description);
  }
  auto* command = app.add_subcommand("reproduce", "Repeat a study of the paper: tables and figures. No server is needed.");
  command->footer("Experiments:" + list);
  auto flags = std::make_shared<Flags>();
  command->add_option("EXPERIMENT", flags->experiment, Names())->required();
  command->add_option("--budget", flags->budget, "quick: some minutes on two cores; full: all runs (default quick)")
      ->check(CLI::IsMember({"quick", "full"}));
  command->add_option("--seeds", flags->seeds, "Runs with seeds of their own; default: the budget's")
      ->check(CLI::PositiveNumber);
  command->add_option("--data", flags->data, "Bouc–Wen: the measured estimation signal (u1, y1) instead of a simulated one");
  command->add_option("--out", flags->out, "Directory for protocol, tables and figures (default: the experiment's name)");
  OnChosen(command, chosen, [flags, &console] { return Reproduce(*flags, console); });
}

}  // namespace metaekf::cli
