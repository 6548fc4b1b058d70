#include "core/experiments/experiment.h"

#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>

#include "absl/strings/str_join.h"
#include "core/base/status.h"
#include "core/experiments/studies.h"

namespace metaekf::experiments {
namespace {

absl::Status WriteText(const std::string& directory, const std::string& name, const std::string& text) {
  const std::string path = (std::filesystem::path(directory) / name).string();
  std::ofstream file(path, std::ios::binary);
  if (!file) return absl::NotFoundError(absl::StrCat("cannot write ", path));
  file << text;
  file.close();
  if (!file) return absl::DataLossError(absl::StrCat("writing ", path, " failed; is the disk full?"));
  return absl::OkStatus();
}

}  // namespace

const std::vector<Experiment>& Experiments() {
  static const std::vector<Experiment> experiments = {VanDerPolComparison(), BoucWenTables(), FewShotCurve(),
                                                      AnilHeatmap(), Localization(), VaporCompressionStudy(), Calibration()};
  return experiments;
}

absl::StatusOr<const Experiment*> FindExperiment(const std::string& name) {
  std::vector<std::string> names;
  for (const Experiment& experiment : Experiments()) {
    if (experiment.name == name) return &experiment;
    names.push_back(experiment.name);
  }
  return absl::NotFoundError(absl::StrCat("no experiment \"", name, "\"; there are ", absl::StrJoin(names, ", ")));
}

absl::Status WriteProtocol(const nlohmann::json& protocol, const std::string& directory) {
  std::error_code error;
  std::filesystem::create_directories(directory, error);
  if (error) return absl::NotFoundError(absl::StrCat("cannot create ", directory, ": ", error.message()));
  return WriteText(directory, "protocol.json", protocol.dump(2) + "\n");
}

std::string ToText(const Report& report) {
  std::string text;
  for (const Table& table : report.tables) absl::StrAppend(&text, ToText(table), "\n");
  for (const std::string& finding : report.findings) absl::StrAppend(&text, finding, "\n");
  return text;
}

absl::Status WriteReport(const Report& report, const std::string& directory) {
  METAEKF_RETURN_IF_ERROR(WriteText(directory, "results.txt", ToText(report)));
  for (const Table& table : report.tables) {
    METAEKF_RETURN_IF_ERROR(WriteText(directory, table.name + ".csv", ToCsv(table)));
  }
  for (const Picture& picture : report.pictures) {
    METAEKF_RETURN_IF_ERROR(WriteText(directory, picture.name + ".svg", picture.svg));
  }
  return absl::OkStatus();
}

}  // namespace metaekf::experiments
