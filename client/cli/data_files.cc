#include "client/cli/data_files.h"

#include <CLI/CLI.hpp>
#include <fstream>
#include <sstream>
#include <utility>

#include "absl/strings/str_join.h"
#include "absl/strings/str_split.h"
#include "client/cli/mat_file.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

std::optional<std::vector<std::string>> Names(const std::string& list) {
  if (list.empty()) return std::nullopt;
  return std::vector<std::string>(absl::StrSplit(list, ','));
}

std::vector<std::string> Names(const std::vector<client::Channel>& channels) {
  std::vector<std::string> names;
  for (const client::Channel& channel : channels) names.push_back(channel.name);
  return names;
}

absl::StatusOr<std::vector<std::string>> ModelNames(const char* flag, const std::string& list,
                                                    const std::vector<client::Channel>& channels,
                                                    const std::string& label) {
  const std::vector<std::string> expected = Names(channels);
  const std::vector<std::string> names = Names(list).value_or(expected);
  if (names.size() == expected.size()) return names;
  return UsageError(absl::StrCat(flag, " names ", names.size(), " columns, ", label, " has ",
                                 expected.size(), ": ", absl::StrJoin(expected, ", ")));
}

std::string Columns(const data::Dataset& dataset) {
  return absl::StrCat("inputs (", absl::StrJoin(dataset.input_names, ", "), "), outputs (",
                      absl::StrJoin(dataset.output_names, ", "), "), states (",
                      absl::StrJoin(dataset.state_names, ", "), ")");
}

}  // namespace

void DataFlags::AddTo(CLI::App* command) {
  command->add_option("--inputs", inputs, "Columns of the inputs, e.g. a,b (default u1,u2,...)");
  command->add_option("--outputs", outputs, "Columns of the outputs (default y1,y2,...)");
  command->add_option("--states", states, "Columns of the states (default x1,x2,...)");
  command
      ->add_option("--sample-period-s", sample_period_s,
                   "Sample period of files without a column t")
      ->check(CLI::PositiveNumber);
}

absl::StatusOr<TargetModel> DescribeTarget(Console& console, const client::Target& target) {
  if (target.model.empty() == target.adaptation.empty()) {
    return UsageError("give --model NAME or --adaptation ID, one of the two");
  }
  TargetModel described{target, target.model, {}};
  std::string version = target.model;
  if (version.empty()) {
    METAEKF_ASSIGN_OR_RETURN(const client::Adaptation adaptation,
                             ToAbsl(console.client().GetAdaptation(target.adaptation)));
    version = absl::StrCat(adaptation.model, "@", adaptation.model_version);
    described.label = target.adaptation;
  }
  METAEKF_ASSIGN_OR_RETURN(described.version, ToAbsl(console.client().GetModelVersion(version)));
  return described;
}

data::CsvOptions FreeColumns(const DataFlags& flags) {
  return {.inputs = Names(flags.inputs),
          .outputs = Names(flags.outputs),
          .states = Names(flags.states),
          .fallback_sample_period_s = flags.sample_period_s};
}

absl::StatusOr<data::CsvOptions> ModelColumns(const DataFlags& flags, const TargetModel& model,
                                              bool with_states) {
  data::CsvOptions options{.fallback_sample_period_s = flags.sample_period_s};
  const client::Channels& channels = model.version.channels;
  METAEKF_ASSIGN_OR_RETURN(options.inputs,
                           ModelNames("--inputs", flags.inputs, channels.inputs, model.label));
  METAEKF_ASSIGN_OR_RETURN(options.outputs,
                           ModelNames("--outputs", flags.outputs, channels.outputs, model.label));
  options.states.emplace();
  if (with_states && model.version.estimates_states) {
    METAEKF_ASSIGN_OR_RETURN(options.states,
                             ModelNames("--states", flags.states, channels.states, model.label));
  }
  return options;
}

absl::Status WithColumnHint(const absl::Status& status) {
  if (std::string(status.message()).find(" no column \"") == std::string::npos) return status;
  return absl::Status(
      status.code(),
      absl::StrCat(status.message(),
                   "; say which columns are meant with --inputs, --outputs and --states"));
}

absl::StatusOr<std::shared_ptr<std::istream>> OpenDataFile(const std::string& path) {
  if (IsMatFile(path)) {
    METAEKF_ASSIGN_OR_RETURN(std::string text, ReadMatFileAsCsv(path));
    return std::make_shared<std::istringstream>(std::move(text));
  }
  METAEKF_ASSIGN_OR_RETURN(std::ifstream file, data::OpenForReading(path));
  return std::make_shared<std::ifstream>(std::move(file));
}

absl::StatusOr<data::Dataset> ReadData(const std::vector<std::string>& paths,
                                       const data::CsvOptions& options) {
  data::Dataset all;
  for (const std::string& path : paths) {
    METAEKF_ASSIGN_OR_RETURN(const std::shared_ptr<std::istream> file, OpenDataFile(path));
    absl::StatusOr<data::Dataset> read = data::ReadCsv(*file, path, options);
    if (!read.ok()) return WithColumnHint(read.status());
    if (all.trajectories.empty()) {
      all.input_names = read->input_names;
      all.output_names = read->output_names;
      all.state_names = read->state_names;
    } else if (Columns(*read) != Columns(all)) {
      return absl::InvalidArgumentError(absl::StrCat(path, " has ", Columns(*read), ", but ",
                                                     paths.front(), " has ", Columns(all)));
    }
    for (data::Trajectory& trajectory : read->trajectories) {
      if (paths.size() > 1) trajectory.name = absl::StrCat(path, ":", trajectory.name);
      all.trajectories.push_back(std::move(trajectory));
    }
  }
  return all;
}

client::Trajectory ToClient(const data::Trajectory& trajectory) {
  // Column-major with one column per sample is the order of the wire.
  const auto flat = [](const Eigen::MatrixXd& matrix) {
    return std::vector<double>(matrix.data(), matrix.data() + matrix.size());
  };
  return {.name = trajectory.name,
          .start_time_s = trajectory.start_s,
          .sample_period_s = trajectory.sample_period_s,
          .samples = static_cast<size_t>(trajectory.length()),
          .inputs = flat(trajectory.inputs),
          .outputs = flat(trajectory.outputs),
          .states = flat(trajectory.states)};
}

std::vector<client::Trajectory> ToClient(const std::vector<data::Trajectory>& trajectories) {
  std::vector<client::Trajectory> converted;
  for (const data::Trajectory& trajectory : trajectories) converted.push_back(ToClient(trajectory));
  return converted;
}

std::string OutputUnit(const TargetModel& model, size_t i) {
  const auto& outputs = model.version.channels.outputs;
  return i < outputs.size() ? outputs[i].unit : "";
}

}  // namespace metaekf::cli
