#include <cmath>

#include "absl/strings/str_cat.h"
#include "client/cli/commands.h"
#include "client/cli/figures.h"
#include "client/cli/plots.h"
#include "client/cli/records.h"
#include "core/base/numbers.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

struct Flags {
  client::Target target;
  std::string data, mode, out, plot;
  DataFlags columns;
};

/// Empty where there is no value.
void AppendCell(double value, std::string& line) {
  if (!std::isnan(value)) line += base::FormatExact(value);
  line += ',';
}

void AppendPairs(const Eigen::MatrixXd& measured, const Eigen::MatrixXd& predicted, Eigen::Index t,
                 std::string& line) {
  for (Eigen::Index i = 0; i < measured.rows(); ++i) {
    AppendCell(measured(i, t), line);
    AppendCell(predicted(i, t), line);
  }
}

double PeriodS(const data::Trajectory& trajectory, const TargetModel& model) {
  return trajectory.sample_period_s > 0 ? trajectory.sample_period_s
                                        : model.version.sample_period_s;
}

/// trajectory,t, then y1,y1_hat… and x1,x1_hat… where states are predicted.
std::string ToCsv(const data::Dataset& data, const std::vector<Predicted>& predictions,
                  const TargetModel& model) {
  std::string text = "trajectory,t";
  for (const auto& names : {data.output_names, data.state_names}) {
    for (const std::string& name : names) absl::StrAppend(&text, ",", name, ",", name, "_hat");
  }
  text += '\n';
  for (size_t i = 0; i < predictions.size(); ++i) {
    const data::Trajectory& trajectory = data.trajectories[i];
    for (Eigen::Index t = 0; t < trajectory.length(); ++t) {
      absl::StrAppend(&text, trajectory.name, ",");
      AppendCell(trajectory.start_s + static_cast<double>(t) * PeriodS(trajectory, model), text);
      AppendPairs(trajectory.outputs, predictions[i].outputs, t, text);
      AppendPairs(trajectory.states, predictions[i].states, t, text);
      text.back() = '\n';
    }
  }
  return text;
}

std::vector<double> Row(const Eigen::MatrixXd& matrix, Eigen::Index i) {
  return {matrix.row(i).begin(), matrix.row(i).end()};
}

absl::Status Plot(const Flags& flags, const data::Dataset& data, const Predicted& predicted,
                  const TargetModel& model) {
  const data::Trajectory& trajectory = data.trajectories.front();
  std::vector<double> times_s;
  for (Eigen::Index t = 0; t < trajectory.length(); ++t) {
    times_s.push_back(trajectory.start_s + static_cast<double>(t) * PeriodS(trajectory, model));
  }
  std::vector<Curve> curves;
  for (Eigen::Index i = 0; i < trajectory.outputs.rows(); ++i) {
    curves.push_back({.name = data.output_names[static_cast<size_t>(i)],
                      .unit = OutputUnit(model, static_cast<size_t>(i)),
                      .measured = Row(trajectory.outputs, i),
                      .estimate = Row(predicted.outputs, i)});
  }
  const std::string of =
      data.trajectories.size() > 1 ? ", trajectory " + trajectory.name : std::string();
  return WritePlot(absl::StrCat(model.label, ", ", flags.mode, of), times_s, curves, flags.plot);
}

absl::StatusOr<data::Dataset> Read(const Flags& flags, const TargetModel& model) {
  METAEKF_ASSIGN_OR_RETURN(data::CsvOptions options, ModelColumns(flags.columns, model, true));
  // A free run needs measured outputs at its start only.
  options.allow_missing_outputs = flags.mode == "simulate";
  return ReadData({flags.data}, options);
}

Record ByOutput(const data::Dataset& data, const std::vector<double>& values) {
  Record record = Record::object();
  for (size_t i = 0; i < values.size(); ++i) record[data.output_names[i]] = values[i];
  return record;
}

/// The figures; as JSON one object, else a row per output.
void PrintFigures(Console& console, const Flags& flags, const data::Dataset& data,
                  const TargetModel& model, const ErrorFigures& figures, Eigen::Index warmup) {
  if (console.format == Format::kJson) {
    PrintRecord(console, {{"mode", flags.mode},
                          {"samples", figures.samples},
                          {"warmup", warmup},
                          {"rmse", ByOutput(data, figures.rmse)},
                          {"fit_percent", ByOutput(data, figures.fit_percent)}});
    return;
  }
  std::vector<Record> records;
  for (size_t i = 0; i < figures.rmse.size(); ++i) {
    records.push_back({{"output", data.output_names[i]},
                       {"unit", OutputUnit(model, i)},
                       {"rmse", figures.rmse[i]},
                       {"fit_percent", figures.fit_percent[i]},
                       {"mode", flags.mode},
                       {"samples", figures.samples},
                       {"warmup", warmup}});
  }
  PrintRecords(console, {"output", "unit", "rmse", "fit_percent", "mode", "samples", "warmup"},
               records);
}

absl::Status RunPredict(const Flags& flags, Console& console) {
  METAEKF_ASSIGN_OR_RETURN(const TargetModel model, DescribeTarget(console, flags.target));
  METAEKF_ASSIGN_OR_RETURN(const data::Dataset data, Read(flags, model));
  const auto mode = flags.mode == "simulate" ? client::PredictionMode::kSimulate
                                             : client::PredictionMode::kOneStep;
  METAEKF_ASSIGN_OR_RETURN(const std::vector<Predicted> predictions,
                           Predict(console, model, mode, data.trajectories));
  // Where nobody says what to print, it is the predictions.
  const bool csv_to_out =
      flags.out.empty() && (!console.format_given || console.format == Format::kCsv);
  if (!flags.out.empty()) {
    METAEKF_RETURN_IF_ERROR(WriteFile(flags.out, ToCsv(data, predictions, model)));
  }
  if (!flags.plot.empty()) {
    METAEKF_RETURN_IF_ERROR(Plot(flags, data, predictions.front(), model));
  }
  if (csv_to_out) console.out << ToCsv(data, predictions, model);
  if (!csv_to_out) {
    PrintFigures(console, flags, data, model, Score(data.trajectories, predictions),
                 predictions.front().warmup);
  }
  return absl::OkStatus();
}

}  // namespace

void AddPredict(CLI::App& app, Console& console, Command& chosen) {
  auto* command = app.add_subcommand("predict", "Predict recorded trajectories");
  command->footer(
      "Prints the predictions as CSV; with --out writes them there and prints RMSE and Fit "
      "instead, "
      "as with --output table or json.");
  auto flags = std::make_shared<Flags>();
  AddTargetOptions(command, flags->target);
  command->add_option("--data", flags->data, "CSV file")->required();
  command
      ->add_option("--mode", flags->mode,
                   "one-step: from measured outputs up to the sample before; simulate: free run")
      ->required()
      ->check(CLI::IsMember({"one-step", "simulate"}));
  command->add_option("--out", flags->out, "CSV file for the predictions");
  command->add_option("--plot", flags->plot, "SVG file: truth against prediction");
  flags->columns.AddTo(command);
  OnChosen(command, chosen, [flags, &console] { return RunPredict(*flags, console); });
}

}  // namespace metaekf::cli
