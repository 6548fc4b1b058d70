#pragma once

#include <Eigen/Core>
#include <fstream>
#include <istream>
#include <ostream>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/data/csv_rows.h"
#include "core/data/trajectory.h"

namespace metaekf::data {

/// Reads a whole file of trajectories; see CsvRowReader for what it may hold and CsvOptions for the
/// choice of columns.
///
/// Without a column `t`, or with one sample only, a trajectory's sample period is the fallback.
/// `source` names the stream in messages.
///
/// Errors: those of CsvRowReader; InvalidArgument if there is no row; for a path NotFound or
/// PermissionDenied where the file cannot be opened.
absl::StatusOr<Dataset> ReadCsv(std::istream& stream, const std::string& source,
                                const CsvOptions& options = {});
absl::StatusOr<Dataset> ReadCsvFile(const std::string& path, const CsvOptions& options = {});

/// Opens a file to be read as it stands. Errors: NotFound or PermissionDenied.
absl::StatusOr<std::ifstream> OpenForReading(const std::string& path);

/// Writes `dataset` so that ReadCsv gives it back, number by number (NaN for NaN).
///
/// There is a column `trajectory` unless the only trajectory is called "0", and a column `t` if the
/// sample periods are known. A period reads back exactly for trajectories that start at 0, else to
/// rounding. Channels whose names are not u1…, y1…, x1… need CsvOptions to be read again.
///
/// Errors: InvalidArgument if nothing is to be written, channels and names disagree in number, a
/// name is empty or not unique, a trajectory's name is not unique or spans lines, a trajectory has
/// no sample, some sample periods are known and others not, or a value is infinite; for a path also
/// NotFound, PermissionDenied, and DataLoss if writing fails.
absl::Status WriteCsv(const Dataset& dataset, std::ostream& stream);
absl::Status WriteCsvFile(const Dataset& dataset, const std::string& path);

/// Named columns of numbers without further meaning, e.g. one row of parameters per system.
struct Table {
  std::vector<std::string> names;
  Eigen::MatrixXd values;  ///< rows × names
};

/// Reads a table: a header, then numbers. Errors: as ReadCsvFile; a missing value.
absl::StatusOr<Table> ReadTableFile(const std::string& path);

}  // namespace metaekf::data
