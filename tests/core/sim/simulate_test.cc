#include "core/sim/simulate.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <limits>

namespace metaekf::sim {
namespace {

using ::testing::HasSubstr;

absl::StatusOr<Fleet> Simulated(const Request& request) {
  base::Executor* const executor = base::CallingThread();
  return Simulate(request, *executor);
}

std::string ErrorOf(const Request& request) {
  const auto fleet = Simulated(request);
  EXPECT_EQ(fleet.status().code(), absl::StatusCode::kInvalidArgument);
  return std::string(fleet.status().message());
}

Request Small() { return {.system = "bouc-wen", .systems = 3, .seed = 5, .steps = 40}; }

void ExpectSameSystem(const Fleet& a, size_t i, const Fleet& b, size_t j) {
  EXPECT_EQ(a.dataset.trajectories[i].inputs, b.dataset.trajectories[j].inputs);
  EXPECT_EQ(a.dataset.trajectories[i].outputs, b.dataset.trajectories[j].outputs);
  EXPECT_EQ(a.parameters.values.row(i), b.parameters.values.row(j));
}

TEST(SimulateTest, EverySystemIsListedAndFoundAndSimulatesByDefault) {
  for (const System* system : Systems()) {
    EXPECT_EQ(*FindSystem(system->name), system);
    const auto fleet = Simulated({.system = system->name});
    ASSERT_TRUE(fleet.ok()) << fleet.status();
    const data::Trajectory& trajectory = fleet->dataset.trajectories[0];
    EXPECT_EQ(trajectory.name, "0");
    EXPECT_EQ(trajectory.sample_period_s, system->sample_period_s);
    EXPECT_EQ(trajectory.inputs.rows(), static_cast<Eigen::Index>(system->input_names.size()));
    EXPECT_EQ(trajectory.outputs.rows(), static_cast<Eigen::Index>(system->output_names.size()));
    EXPECT_EQ(fleet->dataset.state_names.size(), static_cast<size_t>(trajectory.states.rows()));
    EXPECT_TRUE(trajectory.outputs.allFinite());
  }
}

TEST(SimulateTest, ASystemDoesNotDependOnTheNumberOfSystemsOrThreads) {
  const auto three = Simulated(Small());
  Request request = Small();
  request.systems = 7;
  const auto executor = base::MakeThreadExecutor(3);
  const auto seven = Simulate(request, *executor);
  ASSERT_TRUE(three.ok() && seven.ok());
  for (size_t i = 0; i < 3; ++i) ExpectSameSystem(*three, i, *seven, i);
  EXPECT_NE(seven->dataset.trajectories[0].outputs, seven->dataset.trajectories[1].outputs);
}

TEST(SimulateTest, TheSeedDecidesEverything) {
  Request request = Small();
  const auto a = Simulated(request);
  const auto same = Simulated(request);
  request.seed = 6;
  const auto other = Simulated(request);
  ExpectSameSystem(*a, 0, *same, 0);
  EXPECT_NE(a->parameters.values.row(0), other->parameters.values.row(0));
  EXPECT_NE(a->dataset.trajectories[0].inputs, other->dataset.trajectories[0].inputs);
}

TEST(SimulateTest, FixingOneParameterLeavesTheOthersAndTheInputAlone) {
  const auto drawn = Simulated(Small());
  Request request = Small();
  request.settings["k_L"] = "4e4";
  const auto fixed = Simulated(request);
  ASSERT_TRUE(fixed.ok());
  EXPECT_EQ(fixed->parameters.names[2], "k_L");
  for (Eigen::Index i = 0; i < 3; ++i) {
    EXPECT_EQ(fixed->parameters.values(i, 2), 4e4);
    EXPECT_EQ(fixed->parameters.values.row(i).tail(4), drawn->parameters.values.row(i).tail(4));
  }
  EXPECT_EQ(fixed->dataset.trajectories[1].inputs, drawn->dataset.trajectories[1].inputs);
  EXPECT_NE(fixed->dataset.trajectories[1].outputs, drawn->dataset.trajectories[1].outputs);
}

TEST(SimulateTest, NominalParametersGiveWayToATableAndToSettings) {
  Request request = Small();
  request.settings = {{"nominal", "1"}, {"m_L", "1.5"}};
  request.parameters = data::Table{{"beta"}, Eigen::Vector3d(600, 700, 800)};
  const auto fleet = Simulated(request);
  ASSERT_TRUE(fleet.ok()) << fleet.status();
  // Nominal values from the paper's tab:bw_params.
  Eigen::RowVectorXd expected(7);
  expected << 1.5, 10, 5e4, 5e4, 700, 0.8, -1.1;
  EXPECT_EQ(fleet->parameters.values.row(1), expected);
}

TEST(SimulateTest, TheParametersUsedReproduceTheFleet) {
  const auto fleet = Simulated(Small());
  Request request = Small();
  request.parameters = fleet->parameters;
  const auto again = Simulated(request);
  ASSERT_TRUE(again.ok()) << again.status();
  for (size_t i = 0; i < 3; ++i) ExpectSameSystem(*fleet, i, *again, i);
}

TEST(SimulateTest, SettingsAreNameAndValue) {
  std::map<std::string, std::string> settings;
  EXPECT_TRUE(AddSetting("k_L=5e4", settings).ok());
  EXPECT_TRUE(AddSetting("excitation=sine", settings).ok());
  EXPECT_EQ(settings["k_L"], "5e4");
  EXPECT_EQ(settings["excitation"], "sine");
  for (const char* text : {"k_L", "=3", "", "k_L=6e4"}) {
    EXPECT_EQ(AddSetting(text, settings).code(), absl::StatusCode::kInvalidArgument) << text;
  }
}

TEST(SimulateTest, AnUnknownSystemIsAnsweredWithTheKnownOnes) {
  const auto fleet = Simulated({.system = "pendulum"});
  EXPECT_EQ(fleet.status().code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(std::string(fleet.status().message()), HasSubstr("van-der-pol, bouc-wen"));
}

TEST(SimulateTest, RefusesNumbersBelowOne) {
  Request request = Small();
  request.systems = 0;
  EXPECT_THAT(ErrorOf(request), HasSubstr("0 systems"));
  request = Small();
  request.steps = 0;
  EXPECT_THAT(ErrorOf(request), HasSubstr("0 steps"));
}

TEST(SimulateTest, RefusesATableThatDoesNotFit) {
  Request request = Small();
  request.parameters = data::Table{{"m_L"}, Eigen::Vector2d(1, 2)};
  EXPECT_THAT(ErrorOf(request), HasSubstr("2 rows for 3 systems"));
  request.parameters = data::Table{{"mass"}, Eigen::Vector3d(1, 2, 3)};
  EXPECT_THAT(ErrorOf(request), HasSubstr("column \"mass\", which is no parameter of bouc-wen"));
  request.parameters = data::Table{{"m_L"}, Eigen::Vector3d(1, 2, 3)};
  request.settings["m_L"] = "2";
  EXPECT_THAT(ErrorOf(request), HasSubstr("m_L is fixed by a setting"));
}

TEST(SimulateTest, RefusesAnInputThatDoesNotFit) {
  Request request = Small();
  request.input = RecordedInput{Eigen::MatrixXd::Zero(2, 50)};
  EXPECT_THAT(ErrorOf(request), HasSubstr("2 channels, bouc-wen takes 1"));
  request.input = RecordedInput{Eigen::MatrixXd::Zero(1, 0)};
  EXPECT_THAT(ErrorOf(request), HasSubstr("empty"));
  request.input = RecordedInput{Eigen::MatrixXd::Zero(1, 50), 0.001};
  EXPECT_THAT(ErrorOf(request), HasSubstr("0.001 s, bouc-wen of 0.00133333 s"));
  request.input =
      RecordedInput{Eigen::MatrixXd::Constant(1, 50, std::numeric_limits<double>::quiet_NaN())};
  EXPECT_THAT(ErrorOf(request), HasSubstr("not finite"));
}

TEST(SimulateTest, AFailureNamesTheSystem) {
  Request request = Small();
  request.parameters = data::Table{{"m_L"}, Eigen::Vector3d(1, -2, 3)};
  EXPECT_THAT(ErrorOf(request), HasSubstr("system 1: m_L=-2"));
}

}  // namespace
}  // namespace metaekf::sim
