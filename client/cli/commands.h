#pragma once

#include <CLI/CLI.hpp>
#include <functional>
#include <utility>

#include "absl/status/status.h"
#include "client/cli/console.h"

namespace metaekf::cli {

/// What a subcommand does once it has been chosen; set while the command line is read.
using Command = std::function<absl::Status()>;

/// Each adds one subcommand to `app`, with its options and its help; when it is chosen, it sets
/// `chosen`. The console must outlive the app.
void AddDoctor(CLI::App& app, Console& console, Command& chosen);
void AddSimulate(CLI::App& app, Console& console, Command& chosen);
void AddTrain(CLI::App& app, Console& console, Command& chosen);
void AddJobs(CLI::App& app, Console& console, Command& chosen);
void AddModels(CLI::App& app, Console& console, Command& chosen);
void AddAdapt(CLI::App& app, Console& console, Command& chosen);
void AddAdaptations(CLI::App& app, Console& console, Command& chosen);
void AddPredict(CLI::App& app, Console& console, Command& chosen);
void AddEstimate(CLI::App& app, Console& console, Command& chosen);
void AddCompare(CLI::App& app, Console& console, Command& chosen);
void AddReproduce(CLI::App& app, Console& console, Command& chosen);
void AddStatus(CLI::App& app, Console& console, Command& chosen);
void AddAdmin(CLI::App& app, Console& console, Command& chosen);
/// Of "metaekf admin".
void AddBackups(CLI::App& admin, Console& console, Command& chosen);

/// Lets `command` be what is chosen with `subcommand`.
inline void OnChosen(CLI::App* subcommand, Command& chosen, Command command) {
  subcommand->callback([&chosen, command = std::move(command)] { chosen = command; });
}

/// Options --model and --adaptation.
inline void AddTargetOptions(CLI::App* command, client::Target& target) {
  auto* model = command->add_option("--model", target.model, "Model: NAME[@VERSION|@ALIAS]");
  command->add_option("--adaptation", target.adaptation, "Adaptation, by its id")->excludes(model);
}

}  // namespace metaekf::cli
