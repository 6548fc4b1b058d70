#include "core/experiments/experiment.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <set>

#include "core/experiments/bouc_wen_data.h"
#include "core/experiments/bouc_wen_learners.h"
#include "core/experiments/learner.h"
#include "tests/support/sanitized.h"

namespace metaekf::experiments {
namespace {

using ::testing::HasSubstr;
using ::testing::StartsWith;

Report RunTiny(const Experiment& experiment, size_t threads) {
  const auto executor = base::MakeThreadExecutor(threads);
  const absl::StatusOr<Report> report = experiment.run({.budget = Budget::kTiny}, executor.get(), nullptr);
  EXPECT_TRUE(report.ok()) << experiment.name << ": " << report.status();
  return report.ok() ? *report : Report();
}

/// All that must not depend on the machine: everything but times.
std::string WithoutTimes(const Report& report) {
  std::string text;
  for (const Table& table : report.tables) {
    if (table.name != "times") text += ToCsv(table);
  }
  for (const std::string& finding : report.findings) text += finding;
  for (const Picture& picture : report.pictures) text += picture.svg;
  return text;
}

class EveryExperiment : public ::testing::TestWithParam<std::string> {
 protected:
  const Experiment& experiment() const { return **FindExperiment(GetParam()); }
};

TEST_P(EveryExperiment, RunsEndToEndAndTheSameOnAnyNumberOfThreads) {
  const Report report = RunTiny(experiment(), 2);
  ASSERT_FALSE(report.tables.empty());
  ASSERT_FALSE(report.pictures.empty());
  EXPECT_FALSE(report.findings.empty());
  size_t measured = 0;
  for (const Table& table : report.tables) {
    for (const Row& row : table.rows) {
      EXPECT_LE(row.cells.size(), table.columns.size());
      for (const auto& cell : row.cells) measured += cell.empty() ? 0 : cell.size() - Summarise(cell, false).failed;
    }
  }
  EXPECT_GT(measured, 10u);
  for (const Picture& picture : report.pictures) {
    EXPECT_THAT(picture.svg, StartsWith("<svg"));
    EXPECT_EQ(picture.svg.find("nan"), std::string::npos);
  }
  if (METAEKF_SANITIZED) return;  // nothing is to be found by going the same way again
  EXPECT_EQ(WithoutTimes(report), WithoutTimes(RunTiny(experiment(), 1)));
}

TEST_P(EveryExperiment, EveryLearnerOfEveryBudgetHasASpecificationThatIsAccepted) {
  for (const Budget budget : {Budget::kTiny, Budget::kQuick, Budget::kFull}) {
    const nlohmann::json protocol = experiment().protocol({.budget = budget});
    EXPECT_GE(protocol["learners"].size(), 5u);
    for (const nlohmann::json& learner : protocol["learners"]) {
      const absl::Status status = meta::ReadTrainingSpec(learner["specification"]).status();
      EXPECT_TRUE(status.ok()) << learner["label"] << ": " << status;
    }
  }
}

TEST_P(EveryExperiment, WritesItsProtocolAndItsReport) {
  const std::string directory = ::testing::TempDir() + "metaekf_report/" + GetParam();
  std::filesystem::remove_all(directory);
  const Options options{.budget = Budget::kTiny};
  ASSERT_TRUE(WriteProtocol(experiment().protocol(options), directory).ok());
  const Report report{{{.name = "errors", .title = "Errors", .columns = {{"RMSE"}}, .rows = {{"a", {{1}}}}}}, {"Found."},
                      {{"curve", "<svg/>"}}};
  ASSERT_TRUE(WriteReport(report, directory).ok());
  std::ifstream file(directory + "/protocol.json");
  const nlohmann::json protocol = nlohmann::json::parse(file);
  EXPECT_EQ(protocol["experiment"], GetParam());
  EXPECT_TRUE(protocol.contains("first_seed"));
  for (const char* name : {"results.txt", "errors.csv", "curve.svg"}) {
    EXPECT_TRUE(std::filesystem::exists(directory + "/" + name)) << name;
  }
}

TEST_P(EveryExperiment, StopsWhenTold) {
  base::Executor* const executor = base::CallingThread();
  const absl::StatusOr<Report> report =
      experiment().run({.budget = Budget::kTiny}, executor, [](size_t, size_t, const std::string&) { return false; });
  EXPECT_TRUE(absl::IsCancelled(report.status())) << report.status();
}

std::vector<std::string> Names() {
  std::vector<std::string> names;
  for (const Experiment& experiment : Experiments()) names.push_back(experiment.name);
  return names;
}

INSTANTIATE_TEST_SUITE_P(All, EveryExperiment, ::testing::ValuesIn(Names()), [](const auto& one) {
  std::string name = one.param;
  std::erase(name, '-');
  return name;
});

TEST(ExperimentTest, AnUnknownNameIsAnsweredWithThoseThatExist) {
  const auto found = FindExperiment("pendulum");
  EXPECT_TRUE(absl::IsNotFound(found.status()));
  EXPECT_THAT(std::string(found.status().message()), HasSubstr("van-der-pol-comparison"));
}

TEST(ExperimentTest, ALearnerThatDivergesDoesNotStopTheOthers) {
  const auto executor = base::MakeThreadExecutor(2);
  const auto fleet = BoucWenFleet(4, 300, BoucWenExcitation::kMultisine, 1, executor.get());
  ASSERT_TRUE(fleet.ok()) << fleet.status();
  const Learner maml = BoucWenLearners(Budget::kTiny)[1];
  Learner diverging = maml;
  diverging.specification["warmup_lr"] = 1000;
  const auto trainings = TrainAll({diverging, maml}, fleet->dataset, {}, 1, executor.get(), nullptr);
  ASSERT_TRUE(trainings.ok()) << trainings.status();
  EXPECT_TRUE(absl::IsOutOfRange((*trainings)[0].bundle.status())) << (*trainings)[0].bundle.status();
  EXPECT_TRUE((*trainings)[1].bundle.ok()) << (*trainings)[1].bundle.status();
  // Nor those that know nothing of the fleet.
  for (const Learner& like : {BoucWenLearners(Budget::kTiny)[0], diverging}) {
    const auto from_scratch = FitFromScratch(like, fleet->dataset.trajectories[0], 1);
    EXPECT_TRUE(from_scratch.ok()) << from_scratch.status();
  }
}

TEST(ExperimentTest, ADirectoryThatCannotBeWrittenIsNamed) {
  const absl::Status status = WriteProtocol({}, "/proc/no/such");
  EXPECT_TRUE(absl::IsNotFound(status));
  EXPECT_THAT(std::string(status.message()), HasSubstr("/proc/no/such"));
}

}  // namespace
}  // namespace metaekf::experiments
