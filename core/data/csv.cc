#include "core/data/csv.h"

#include <cerrno>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <set>
#include <utility>

#include "core/base/numbers.h"
#include "core/base/status.h"

namespace metaekf::data {
namespace {

absl::Status OpenError(const std::string& path, const char* verb) {
  const int error = errno;
  return absl::Status(
      error == EACCES ? absl::StatusCode::kPermissionDenied : absl::StatusCode::kNotFound,
      absl::StrCat("cannot ", verb, " ", path, ": ", std::strerror(error)));
}

/// Collects the rows of one trajectory; the matrices are made when their number is known.
struct Columns {
  std::vector<double> inputs, outputs, states;
  Eigen::Index count = 0;

  void Add(const CsvRow& row) {
    inputs.insert(inputs.end(), row.inputs.begin(), row.inputs.end());
    outputs.insert(outputs.end(), row.outputs.begin(), row.outputs.end());
    states.insert(states.end(), row.states.begin(), row.states.end());
    ++count;
  }
  void MoveTo(Trajectory& trajectory) {
    const auto matrix = [this](const std::vector<double>& values) {
      const Eigen::Index rows = static_cast<Eigen::Index>(values.size()) / count;
      return Eigen::MatrixXd(Eigen::Map<const Eigen::MatrixXd>(values.data(), rows, count));
    };
    trajectory.inputs = matrix(inputs);
    trajectory.outputs = matrix(outputs);
    trajectory.states = matrix(states);
    *this = Columns();
  }
};

absl::Status CheckWritable(const Dataset& dataset, const std::vector<std::string>& names) {
  if (dataset.trajectories.empty()) return absl::InvalidArgumentError("no trajectory to write");
  if (names.empty()) return absl::InvalidArgumentError("no channel to write");
  std::set<std::string> seen = {"t", "trajectory"};
  for (const std::string& name : names) {
    if (name.empty() || name.find_first_of("\n\r") != std::string::npos ||
        !seen.insert(name).second) {
      return absl::InvalidArgumentError(
          absl::StrCat("\"", name,
                       "\" cannot name a column: names must be of one line, distinct, "
                       "and neither t nor trajectory"));
    }
  }
  std::set<std::string> trajectories;
  const bool timed = dataset.trajectories.front().sample_period_s > 0;
  for (const Trajectory& trajectory : dataset.trajectories) {
    const std::string& name = trajectory.name;
    if (name.find_first_of("\n\r") != std::string::npos || !trajectories.insert(name).second) {
      return absl::InvalidArgumentError(absl::StrCat(
          "\"", name, "\" cannot name a trajectory: names must be of one line and distinct"));
    }
    if ((trajectory.sample_period_s > 0) != timed) {
      return absl::InvalidArgumentError(absl::StrCat(
          "the sample period of trajectory ", timed ? name : dataset.trajectories.front().name,
          " is not known, others are; one file holds one kind"));
    }
    const Eigen::Index length = trajectory.length();
    if (length == 0) {
      return absl::InvalidArgumentError(absl::StrCat("trajectory ", name, " has no sample"));
    }
    const auto fits = [length](const Eigen::MatrixXd& values, const auto& channels) {
      return values.rows() == static_cast<Eigen::Index>(channels.size()) && values.cols() == length;
    };
    if (!fits(trajectory.inputs, dataset.input_names) ||
        !fits(trajectory.outputs, dataset.output_names) ||
        !fits(trajectory.states, dataset.state_names)) {
      return absl::InvalidArgumentError(
          absl::StrCat("the signals of trajectory ", name,
                       " do not have the channels of the dataset, or differ "
                       "in length"));
    }
  }
  return absl::OkStatus();
}

std::string Quoted(const std::string& name) {
  const bool plain = name.find_first_of(",\"\t") == std::string::npos && !name.starts_with(' ') &&
                     !name.ends_with(' ');
  if (plain) return name;
  std::string quoted = "\"";
  for (const char c : name) quoted.append(c == '"' ? 2 : 1, c);
  return quoted + '"';
}

/// Appends a cell and a comma; EndLine turns the last comma into the end of the line.
void AppendCell(const std::string& cell, std::string& line) {
  line += cell;
  line += ',';
}

void EndLine(std::string& line, std::ostream& stream) {
  line.back() = '\n';
  stream << line;
  line.clear();
}

/// Appends column `t` of a signal; false if a value is infinite.
bool AppendValues(const Eigen::MatrixXd& signal, Eigen::Index t, std::string& line) {
  for (Eigen::Index i = 0; i < signal.rows(); ++i) {
    if (std::isinf(signal(i, t))) return false;
    AppendCell(base::FormatExact(signal(i, t)), line);
  }
  return true;
}

}  // namespace

absl::StatusOr<std::ifstream> OpenForReading(const std::string& path) {
  std::error_code ignored;
  if (std::filesystem::is_directory(path, ignored)) {
    return absl::NotFoundError(absl::StrCat("cannot read ", path, ": it is a directory"));
  }
  std::ifstream file(path, std::ios::binary);
  if (!file) return OpenError(path, "read");
  return file;
}

absl::StatusOr<Dataset> ReadCsv(std::istream& stream, const std::string& source,
                                const CsvOptions& options) {
  METAEKF_ASSIGN_OR_RETURN(CsvRowReader reader, CsvRowReader::Open(stream, source, options));
  Dataset dataset{reader.input_names(), reader.output_names(), reader.state_names(), {}};
  CsvRow row;
  Columns columns;
  EvenTime time;
  while (true) {
    METAEKF_ASSIGN_OR_RETURN(const bool found, reader.Next(row));
    if (columns.count > 0 && (!found || row.starts_trajectory)) {
      Trajectory& trajectory = dataset.trajectories.back();
      columns.MoveTo(trajectory);
      trajectory.start_s = time.start_s();
      trajectory.sample_period_s = time.PeriodS();
      if (trajectory.sample_period_s == 0) {
        trajectory.sample_period_s = options.fallback_sample_period_s;
      }
    }
    if (!found) break;
    if (row.starts_trajectory) dataset.trajectories.emplace_back().name = row.trajectory;
    columns.Add(row);
    time = reader.time();
  }
  if (dataset.trajectories.empty()) {
    return absl::InvalidArgumentError(absl::StrCat(source, ": no row follows the header"));
  }
  return dataset;
}

absl::StatusOr<Dataset> ReadCsvFile(const std::string& path, const CsvOptions& options) {
  METAEKF_ASSIGN_OR_RETURN(std::ifstream file, OpenForReading(path));
  return ReadCsv(file, path, options);
}

absl::Status WriteCsv(const Dataset& dataset, std::ostream& stream) {
  std::vector<std::string> names = dataset.input_names;
  names.insert(names.end(), dataset.output_names.begin(), dataset.output_names.end());
  names.insert(names.end(), dataset.state_names.begin(), dataset.state_names.end());
  METAEKF_RETURN_IF_ERROR(CheckWritable(dataset, names));

  const bool named = dataset.trajectories.size() > 1 || dataset.trajectories.front().name != "0";
  const bool timed = dataset.trajectories.front().sample_period_s > 0;
  std::string line;
  if (named) AppendCell("trajectory", line);
  if (timed) AppendCell("t", line);
  for (const std::string& name : names) AppendCell(Quoted(name), line);
  EndLine(line, stream);
  for (const Trajectory& trajectory : dataset.trajectories) {
    const std::string quoted_name = Quoted(trajectory.name);
    for (Eigen::Index t = 0; t < trajectory.length(); ++t) {
      if (named) AppendCell(quoted_name, line);
      if (timed) {
        const double time_s =
            trajectory.start_s + static_cast<double>(t) * trajectory.sample_period_s;
        AppendCell(base::FormatExact(time_s), line);
      }
      if (!AppendValues(trajectory.inputs, t, line) || !AppendValues(trajectory.outputs, t, line) ||
          !AppendValues(trajectory.states, t, line)) {
        return absl::InvalidArgumentError(
            absl::StrCat("trajectory ", trajectory.name, ", sample ", t, ": an infinite value"));
      }
      EndLine(line, stream);
    }
  }
  return absl::OkStatus();
}

absl::Status WriteCsvFile(const Dataset& dataset, const std::string& path) {
  std::ofstream file(path, std::ios::binary);
  if (!file) return OpenError(path, "write");
  METAEKF_RETURN_IF_ERROR(WriteCsv(dataset, file));
  file.close();
  if (!file)
    return absl::DataLossError(absl::StrCat("writing ", path, " failed; is the disk full?"));
  return absl::OkStatus();
}

absl::StatusOr<Table> ReadTableFile(const std::string& path) {
  METAEKF_ASSIGN_OR_RETURN(std::ifstream file, OpenForReading(path));
  METAEKF_ASSIGN_OR_RETURN(CsvLines lines, CsvLines::Open(file, path));
  std::vector<double> values;
  while (true) {
    METAEKF_ASSIGN_OR_RETURN(const bool found, lines.Next());
    if (!found) break;
    for (int column = 0; column < static_cast<int>(lines.header().size()); ++column) {
      METAEKF_ASSIGN_OR_RETURN(const double value, lines.Number(column));
      if (std::isnan(value)) return lines.Error(column, "a value is missing here");
      values.push_back(value);
    }
  }
  if (values.empty()) {
    return absl::InvalidArgumentError(absl::StrCat(path, ": no row follows the header"));
  }
  const Eigen::Index columns = static_cast<Eigen::Index>(lines.header().size());
  const Eigen::Index rows = static_cast<Eigen::Index>(values.size()) / columns;
  return Table{lines.header(),
               Eigen::Map<const Eigen::MatrixXd>(values.data(), columns, rows).transpose()};
}

}  // namespace metaekf::data
