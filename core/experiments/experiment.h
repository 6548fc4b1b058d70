#pragma once

#include <cstdint>
#include <functional>
#include <nlohmann/json_fwd.hpp>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/executor.h"
#include "core/data/trajectory.h"
#include "core/experiments/table.h"

namespace metaekf::experiments {

/// How much is computed: kQuick some minutes on two cores, kFull what is reported. kTiny takes seconds and says nothing
/// about learning: it is there to see that everything runs.
enum class Budget { kTiny, kQuick, kFull };

struct Options {
  Budget budget = Budget::kQuick;
  std::optional<int> seeds;  ///< runs; without it, what the budget has
  /// Of the Bouc–Wen studies: the measured estimation signal; without it, one is simulated.
  std::optional<data::Trajectory> recording;
};

/// A file of a report: a figure as SVG text.
struct Picture {
  std::string name;  ///< of the file
  std::string svg;
};

/// What a study has found.
struct Report {
  std::vector<Table> tables;
  std::vector<std::string> findings;  ///< sentences, computed from the numbers
  std::vector<Picture> pictures;
};

/// Called with (steps done, of steps, what is being done); false stops the study.
using OnProgress = std::function<bool(size_t, size_t, const std::string&)>;

/// A study of the paper that can be repeated.
struct Experiment {
  std::string name;
  std::string description;
  /// Everything that was settled before training: specifications, data, seeds.
  nlohmann::json (*protocol)(const Options&) = nullptr;
  /// Results depend on the options alone, except for times.
  /// Errors: InvalidArgument for a recording that cannot be used; Cancelled if on_progress said so.
  absl::StatusOr<Report> (*run)(const Options&, base::Executor*, const OnProgress&) = nullptr;
};

/// All studies, in the order in which help lists them.
const std::vector<Experiment>& Experiments();

/// Errors: NotFound, with the names that exist.
absl::StatusOr<const Experiment*> FindExperiment(const std::string& name);

/// Creates the directory and writes protocol.json into it: before a study, so that what was settled stands there first, and
/// a directory that cannot be written is noticed at once. Errors: NotFound or DataLoss with the path.
absl::Status WriteProtocol(const nlohmann::json& protocol, const std::string& directory);

/// Tables and findings as one text.
std::string ToText(const Report& report);

/// Writes results.txt, a CSV file per table and the pictures. Errors: as WriteProtocol.
absl::Status WriteReport(const Report& report, const std::string& directory);

}  // namespace metaekf::experiments
