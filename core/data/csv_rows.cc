#include "core/data/csv_rows.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_join.h"
#include "core/base/status.h"

namespace metaekf::data {
namespace {

/// k of a column called letter + k, such as u1; 0 for any other name.
int NumberInName(const std::string& name, char letter) {
  int number = 0;
  if (name.size() < 2 || name[0] != letter || name[1] < '1' || name[1] > '9') return 0;
  return absl::SimpleAtoi(name.substr(1), &number) ? number : 0;
}

}  // namespace

absl::StatusOr<CsvRowReader> CsvRowReader::Open(std::istream& stream, std::string source,
                                                const CsvOptions& options) {
  METAEKF_ASSIGN_OR_RETURN(CsvLines lines, CsvLines::Open(stream, std::move(source)));
  CsvRowReader reader(std::move(lines), options);
  METAEKF_RETURN_IF_ERROR(reader.FindColumns());
  return reader;
}

absl::Status CsvRowReader::FindColumns() {
  time_column_ = lines_.Find("t");
  trajectory_column_ = lines_.Find("trajectory");
  METAEKF_RETURN_IF_ERROR(FindSignal(options_.inputs, 'u', inputs_));
  METAEKF_RETURN_IF_ERROR(FindSignal(options_.outputs, 'y', outputs_));
  METAEKF_RETURN_IF_ERROR(FindSignal(options_.states, 'x', states_));

  std::vector<bool> used(lines_.header().size(), false);
  if (time_column_ >= 0) used[time_column_] = true;
  if (trajectory_column_ >= 0) used[trajectory_column_] = true;
  bool any_signal = false;
  for (const Signal* signal : {&inputs_, &outputs_, &states_}) {
    for (const int column : signal->columns) {
      if (used[column]) return lines_.Error(column, "is asked for twice");
      used[column] = true;
      any_signal = true;
    }
  }
  const bool mapped = options_.inputs || options_.outputs || options_.states;
  const auto unknown = std::find(used.begin(), used.end(), false);
  if (!mapped && unknown != used.end()) {
    return lines_.Error(static_cast<int>(unknown - used.begin()),
                        "unknown; columns are trajectory, t, u1…, y1…, x1…, or say which are the "
                        "inputs, outputs and states");
  }
  if (!any_signal) return lines_.Error(-1, "no column of an input, output or state");
  return absl::OkStatus();
}

absl::Status CsvRowReader::FindSignal(const std::optional<std::vector<std::string>>& names,
                                      char letter, Signal& signal) {
  if (names) {
    signal.names = *names;
  } else {
    int highest = 0;
    size_t count = 0;
    for (const std::string& name : lines_.header()) {
      const int number = NumberInName(name, letter);
      highest = std::max(highest, number);
      count += number > 0;
    }
    // The names differ, so as many names as the highest number leave no gap; with a gap, one of the
    // first count + 1 names is missing and is reported below.
    const size_t wanted = static_cast<size_t>(highest) == count ? count : count + 1;
    for (size_t k = 1; k <= wanted; ++k)
      signal.names.push_back(absl::StrCat(std::string(1, letter), k));
  }
  for (const std::string& name : signal.names) {
    signal.columns.push_back(lines_.Find(name));
    if (signal.columns.back() >= 0) continue;
    return lines_.Error(-1, absl::StrCat("no column \"", name, "\"; the columns are ",
                                         absl::StrJoin(lines_.header(), ", ")));
  }
  return absl::OkStatus();
}

absl::Status CsvRowReader::ReadTrajectory(CsvRow& row) {
  const bool named = trajectory_column_ >= 0;
  row.starts_trajectory = !any_row_ || (named && lines_.cells()[trajectory_column_] != current_);
  any_row_ = true;
  if (row.starts_trajectory) {
    current_ = named ? std::string(lines_.cells()[trajectory_column_]) : "0";
    time_ = EvenTime();
    if (!trajectories_.insert(current_).second) {
      return lines_.Error(trajectory_column_,
                          absl::StrCat("\"", current_,
                                       "\" comes back; the rows of a trajectory "
                                       "must stand together"));
    }
  }
  row.trajectory = current_;
  return absl::OkStatus();
}

absl::Status CsvRowReader::ReadSignal(const Signal& signal, bool allow_missing,
                                      Eigen::VectorXd& values) const {
  values.resize(static_cast<Eigen::Index>(signal.columns.size()));
  for (Eigen::Index i = 0; i < values.size(); ++i) {
    METAEKF_ASSIGN_OR_RETURN(values[i], lines_.Number(signal.columns[i]));
    if (std::isnan(values[i]) && !allow_missing) {
      return lines_.Error(signal.columns[i], "a value is missing here, and none may be");
    }
  }
  return absl::OkStatus();
}

absl::StatusOr<bool> CsvRowReader::Next(CsvRow& row) {
  METAEKF_ASSIGN_OR_RETURN(const bool found, lines_.Next());
  if (!found) return false;
  row.line = lines_.line();
  METAEKF_RETURN_IF_ERROR(ReadTrajectory(row));
  row.time_s = std::numeric_limits<double>::quiet_NaN();
  if (time_column_ >= 0) {
    METAEKF_ASSIGN_OR_RETURN(row.time_s, lines_.Number(time_column_));
    if (std::isnan(row.time_s)) return lines_.Error(time_column_, "a time is missing here");
    if (options_.allow_any_times) {
      if (!std::isfinite(row.time_s)) return lines_.Error(time_column_, "a time must be finite");
    } else if (absl::Status even = time_.Add(lines_.cells()[time_column_], row.time_s); !even.ok()) {
      return lines_.Error(time_column_, std::string(even.message()));
    }
  }
  METAEKF_RETURN_IF_ERROR(ReadSignal(inputs_, false, row.inputs));
  METAEKF_RETURN_IF_ERROR(ReadSignal(outputs_, options_.allow_missing_outputs, row.outputs));
  METAEKF_RETURN_IF_ERROR(ReadSignal(states_, false, row.states));
  return true;
}

}  // namespace metaekf::data
