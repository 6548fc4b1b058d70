#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <istream>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/data/csv_lines.h"
#include "core/data/even_time.h"

namespace metaekf::data {

/// Which columns of a file are which signals, and what may be missing.
struct CsvOptions {
  /// Names of the columns of a signal, in order. Left out: "u1", "u2", … (outputs "y1", …, states
  /// "x1", …), as many as there are, ordered by number wherever they stand in the file. An empty
  /// list leaves the signal out. If any of the three is given, columns that belong to none are
  /// ignored; otherwise they are an error, since a misspelt name would silently lose a signal.
  std::optional<std::vector<std::string>> inputs, outputs, states;
  /// Accepts an empty cell or NaN in an output: a value that was not measured.
  bool allow_missing_outputs = false;
  bool allow_any_times = false;  ///< for streams whose samples may be missing or late
  /// Sample period of trajectories where the file does not tell it; 0 if unknown. For ReadCsv.
  double fallback_sample_period_s = 0;
};

/// One sample.
struct CsvRow {
  int64_t line = 0;        ///< in the file, counted from 1
  std::string trajectory;  ///< "0" without a column `trajectory`
  bool starts_trajectory = false;
  double time_s = 0;  ///< NaN without a column `t`
  Eigen::VectorXd inputs, outputs, states;
};

/// Reads the project's CSV one sample at a time, so that a pipe can be followed as it is written.
///
/// Columns `trajectory` (any text; the rows of one stand together) and `t` (seconds, even) are
/// optional. Everything is checked as it comes; CsvLines says which variations of CSV are
/// understood.
class CsvRowReader {
 public:
  /// Reads the header and finds the columns. The stream must outlive the reader; `source` names it
  /// in messages.
  ///
  /// Errors (InvalidArgument): those of CsvLines::Open; a column of `options` that the file lacks
  /// or that is asked for twice; an unknown column (see CsvOptions); a number left out in a row of
  /// names (u1, u3); no signal at all.
  static absl::StatusOr<CsvRowReader> Open(std::istream& stream, std::string source,
                                           const CsvOptions& options = {});

  /// Reads the next sample into `row`; false at the end.
  ///
  /// Errors (InvalidArgument, with source, line and column): those of CsvLines::Next; text or an
  /// infinite value where a number belongs; a missing time, input or state; a missing output unless
  /// allowed; uneven time (see EvenTime); a trajectory that was left and comes back.
  absl::StatusOr<bool> Next(CsvRow& row);

  const std::vector<std::string>& input_names() const { return inputs_.names; }
  const std::vector<std::string>& output_names() const { return outputs_.names; }
  const std::vector<std::string>& state_names() const { return states_.names; }

  /// Column `t` of the current trajectory so far: its start and period. Without that column, empty.
  const EvenTime& time() const { return time_; }

 private:
  struct Signal {
    std::vector<std::string> names;
    std::vector<int> columns;
  };

  CsvRowReader(CsvLines lines, const CsvOptions& options)
      : lines_(std::move(lines)), options_(options) {}

  absl::Status FindColumns();
  absl::Status FindSignal(const std::optional<std::vector<std::string>>& names, char letter,
                          Signal& signal);
  absl::Status ReadSignal(const Signal& signal, bool allow_missing, Eigen::VectorXd& values) const;
  absl::Status ReadTrajectory(CsvRow& row);

  CsvLines lines_;
  CsvOptions options_;
  Signal inputs_, outputs_, states_;
  int time_column_ = -1;
  int trajectory_column_ = -1;
  EvenTime time_;
  std::set<std::string> trajectories_;  // seen so far
  std::string current_;
  bool any_row_ = false;
};

}  // namespace metaekf::data
