#pragma once

#include <istream>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/cli/console.h"
#include "core/data/csv.h"
#include "core/data/trajectory.h"

namespace CLI {
class App;
}

namespace metaekf::cli {

/// The options that say how data files are to be read.
struct DataFlags {
  std::string inputs, outputs, states;  ///< comma-separated column names
  double sample_period_s = 0;

  void AddTo(CLI::App* command);
};

/// What a model or adaptation is, as far as reading data for it goes.
struct TargetModel {
  client::Target target;
  std::string label;  ///< as the user wrote it
  client::ModelVersion version;
};

/// Asks the server. Errors: as the calls; NotFound says how to list what there is.
absl::StatusOr<TargetModel> DescribeTarget(Console& console, const client::Target& target);

/// Columns for data that a model is to learn from: as the flags say, else u1…, y1…, x1….
data::CsvOptions FreeColumns(const DataFlags& flags);

/// Columns for data of a known model: as the flags say, in the model's order, else named like the
/// model's channels. States only if `with_states` and the model has some.
/// Errors: usage, if the flags name another number of columns than the model has channels.
absl::StatusOr<data::CsvOptions> ModelColumns(const DataFlags& flags, const TargetModel& model,
                                              bool with_states);

/// A data file as a stream of CSV; one that ends in .mat is read as ReadMatFileAsCsv says. Errors: NotFound, PermissionDenied;
/// those of ReadMatFileAsCsv.
absl::StatusOr<std::shared_ptr<std::istream>> OpenDataFile(const std::string& path);

/// Reads one file or several, whose trajectories then carry the file's name as well. Errors: those
/// of OpenDataFile and data::ReadCsv, with what to do about a wrong column; files with different columns.
absl::StatusOr<data::Dataset> ReadData(const std::vector<std::string>& paths,
                                       const data::CsvOptions& options);

/// The same error, with how to map columns if it is about one.
absl::Status WithColumnHint(const absl::Status& status);

client::Trajectory ToClient(const data::Trajectory& trajectory);
std::vector<client::Trajectory> ToClient(const std::vector<data::Trajectory>& trajectories);

/// The unit of output i of a model, or "".
std::string OutputUnit(const TargetModel& model, size_t i);

}  // namespace metaekf::cli
