#include <algorithm>

#include "absl/strings/str_cat.h"
#include "client/cli/commands.h"
#include "client/cli/figures.h"
#include "client/cli/records.h"
#include "core/base/status.h"
#include "core/data/split.h"
#include "core/meta/arx.h"

namespace metaekf::cli {
namespace {

struct Flags {
  std::string data;
  std::vector<std::string> models, adaptations;
  std::string arx;
  int64_t arx_samples = 0;
  int arx_order = meta::ArxModel::kDefaultOrder;
  DataFlags columns;
};

/// One row of the comparison.
struct Candidate {
  std::string label;
  std::vector<Predicted> one_step, simulate;
};

Eigen::Index LongestWarmup(const std::vector<Candidate>& candidates) {
  Eigen::Index longest = 0;
  for (const Candidate& candidate : candidates) {
    for (const auto* predictions : {&candidate.one_step, &candidate.simulate}) {
      for (const Predicted& predicted : *predictions) {
        longest = std::max(longest, predicted.warmup);
      }
    }
  }
  return longest;
}

absl::StatusOr<Candidate> PredictWithModel(const Flags& flags, Console& console,
                                           const TargetModel& model) {
  METAEKF_ASSIGN_OR_RETURN(const data::CsvOptions options,
                           ModelColumns(flags.columns, model, true));
  METAEKF_ASSIGN_OR_RETURN(const data::Dataset data, ReadData({flags.data}, options));
  Candidate candidate{.label = model.label};
  METAEKF_ASSIGN_OR_RETURN(
      candidate.one_step,
      Predict(console, model, client::PredictionMode::kOneStep, data.trajectories));
  METAEKF_ASSIGN_OR_RETURN(
      candidate.simulate,
      Predict(console, model, client::PredictionMode::kSimulate, data.trajectories));
  return candidate;
}

absl::StatusOr<Candidate> PredictWithArx(const Flags& flags, const data::CsvOptions& options,
                                         const data::Dataset& data, Eigen::Index warmup) {
  METAEKF_ASSIGN_OR_RETURN(const data::Dataset contexts, ReadData({flags.arx}, options));
  data::Trajectory context = contexts.trajectories.front();
  if (flags.arx_samples > 0) {
    METAEKF_ASSIGN_OR_RETURN(context, data::FirstSamples(context, flags.arx_samples));
  }
  METAEKF_ASSIGN_OR_RETURN(const meta::ArxModel arx, meta::ArxModel::Fit(context, flags.arx_order));
  Candidate candidate{.label = absl::StrCat("ARX(", flags.arx_order, ")")};
  for (const data::Trajectory& trajectory : data.trajectories) {
    const Eigen::Index start = std::max<Eigen::Index>(warmup, flags.arx_order);
    candidate.one_step.push_back({arx.Predict(trajectory, false, warmup), {}, start});
    candidate.simulate.push_back({arx.Predict(trajectory, true, warmup), {}, start});
  }
  return candidate;
}

std::vector<Record> Rows(const std::vector<Candidate>& candidates, const data::Dataset& data,
                         const TargetModel& units) {
  const Eigen::Index first = LongestWarmup(candidates);
  std::vector<Record> rows;
  for (const Candidate& candidate : candidates) {
    const ErrorFigures one_step = Score(data.trajectories, candidate.one_step, first);
    const ErrorFigures simulate = Score(data.trajectories, candidate.simulate, first);
    for (size_t i = 0; i < one_step.rmse.size(); ++i) {
      rows.push_back({{"model", candidate.label},
                      {"output", data.output_names[i]},
                      {"unit", OutputUnit(units, i)},
                      {"one_step_rmse", one_step.rmse[i]},
                      {"one_step_fit_percent", one_step.fit_percent[i]},
                      {"simulate_rmse", simulate.rmse[i]},
                      {"simulate_fit_percent", simulate.fit_percent[i]},
                      {"samples", one_step.samples}});
    }
  }
  return rows;
}

absl::Status Compare(const Flags& flags, Console& console) {
  std::vector<client::Target> targets;
  for (const std::string& model : flags.models) targets.push_back({.model = model});
  for (const std::string& id : flags.adaptations) targets.push_back({.adaptation = id});
  if (targets.empty()) return UsageError("give at least one --model or --adaptation");
  std::vector<Candidate> candidates;
  std::vector<TargetModel> models;
  for (const client::Target& target : targets) {
    METAEKF_ASSIGN_OR_RETURN(models.emplace_back(), DescribeTarget(console, target));
    METAEKF_ASSIGN_OR_RETURN(candidates.emplace_back(),
                             PredictWithModel(flags, console, models.back()));
  }
  METAEKF_ASSIGN_OR_RETURN(const data::CsvOptions options,
                           ModelColumns(flags.columns, models.front(), false));
  METAEKF_ASSIGN_OR_RETURN(const data::Dataset data, ReadData({flags.data}, options));
  if (!flags.arx.empty()) {
    METAEKF_ASSIGN_OR_RETURN(candidates.emplace_back(),
                             PredictWithArx(flags, options, data, LongestWarmup(candidates)));
  }
  PrintRecords(console,
               {"model", "output", "unit", "one_step_rmse", "one_step_fit_percent", "simulate_rmse",
                "simulate_fit_percent", "samples"},
               Rows(candidates, data, models.front()));
  return absl::OkStatus();
}

}  // namespace

void AddCompare(CLI::App& app, Console& console, Command& chosen) {
  auto* command = app.add_subcommand(
      "compare",
      "RMSE and Fit of several models on the same samples, one step ahead and in free run");
  auto flags = std::make_shared<Flags>();
  command->add_option("--data", flags->data, "CSV file")->required();
  command->add_option("--model", flags->models, "Model: NAME[@VERSION|@ALIAS]; repeat")
      ->allow_extra_args(false);
  command->add_option("--adaptation", flags->adaptations, "Adaptation, by its id; repeat")
      ->allow_extra_args(false);
  auto* arx = command->add_option("--arx", flags->arx,
                                  "Context file: adds linear ARX, fitted to its first trajectory");
  command->add_option("--arx-samples", flags->arx_samples, "Fit to the first N samples only")
      ->check(CLI::PositiveNumber)
      ->needs(arx);
  command->add_option("--arx-order", flags->arx_order, "Past samples that ARX takes (default 5)")
      ->check(CLI::PositiveNumber)
      ->needs(arx);
  flags->columns.AddTo(command);
  OnChosen(command, chosen, [flags, &console] { return Compare(*flags, console); });
}

}  // namespace metaekf::cli
