#include "core/sim/van_der_pol.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>

#include "core/sim/simulate.h"

namespace metaekf::sim {
namespace {

using ::testing::HasSubstr;

absl::StatusOr<Fleet> SimulateWith(const std::map<std::string, std::string>& settings,
                                   std::optional<int64_t> steps = std::nullopt,
                                   int64_t systems = 1) {
  base::Executor* const executor = base::CallingThread();
  return Simulate({.system = "van-der-pol",
                   .systems = systems,
                   .seed = 3,
                   .steps = steps,
                   .settings = settings},
                  *executor);
}

TEST(VanDerPolTest, FollowsForwardEuler) {
  const auto fleet = SimulateWith({{"nominal", "1"}}, 3);
  ASSERT_TRUE(fleet.ok()) << fleet.status();
  const data::Trajectory& trajectory = fleet->dataset.trajectories[0];
  // By hand from (1, −0.5), θ = 1.572. First step: x₁ = 1 − 0.005, x₂ = −0.5 + 0.01 (0 − 1).
  // Second: x₁ = 0.995 − 0.0051; 1 − 0.995² = 0.009975; x₂ = −0.51 + 0.01 (1.572 · (−0.51) ·
  // 0.009975 − 0.995).
  EXPECT_NEAR(trajectory.states(0, 1), 0.995, 1e-15);
  EXPECT_NEAR(trajectory.states(1, 1), -0.51, 1e-15);
  EXPECT_NEAR(trajectory.states(0, 2), 0.9899, 1e-15);
  EXPECT_NEAR(trajectory.states(1, 2), -0.52002997157, 1e-10);
  EXPECT_EQ(trajectory.outputs, trajectory.states);
  EXPECT_EQ(trajectory.sample_period_s, 0.01);
}

TEST(VanDerPolTest, ParametersAndLengthsFillTheirRanges) {
  const auto fleet = SimulateWith({}, std::nullopt, 300);
  ASSERT_TRUE(fleet.ok());
  const Eigen::MatrixXd& parameters = fleet->parameters.values;
  EXPECT_THAT(fleet->parameters.names, testing::ElementsAre("theta", "x1_0", "x2_0"));
  // 300 uniform draws come within 5 % of both ends but for a probability of 2 · 0.95³⁰⁰ = 4e-7.
  EXPECT_GE(parameters.col(0).minCoeff(), 0.5);
  EXPECT_LT(parameters.col(0).minCoeff(), 0.575);
  EXPECT_LE(parameters.col(0).maxCoeff(), 2.0);
  EXPECT_GT(parameters.col(0).maxCoeff(), 1.925);
  EXPECT_GE(parameters.rightCols(2).minCoeff(), -1);
  EXPECT_LE(parameters.rightCols(2).maxCoeff(), 1);
  Eigen::Index shortest = 1 << 20, longest = 0;
  for (size_t i = 0; i < 300; ++i) {
    const data::Trajectory& trajectory = fleet->dataset.trajectories[i];
    shortest = std::min(shortest, trajectory.length());
    longest = std::max(longest, trajectory.length());
    EXPECT_EQ(trajectory.states(0, 0), parameters(i, 1));
    EXPECT_EQ(trajectory.states(1, 0), parameters(i, 2));
  }
  EXPECT_GE(shortest, 1000);
  EXPECT_LT(shortest, 1150);
  EXPECT_LE(longest, 4000);
  EXPECT_GT(longest, 3850);
}

TEST(VanDerPolTest, NoiseIsOnTheOutputsOnly) {
  const auto clean = SimulateWith({}, 4000);
  const auto noisy = SimulateWith({{"noise_std", "0.1"}}, 4000);
  ASSERT_TRUE(clean.ok() && noisy.ok());
  const data::Trajectory& trajectory = noisy->dataset.trajectories[0];
  EXPECT_EQ(trajectory.states, clean->dataset.trajectories[0].states);
  const Eigen::MatrixXd noise = trajectory.outputs - trajectory.states;
  // 8000 deviates: the standard deviation of the estimate is 0.1 / √16000 = 8e-4.
  EXPECT_NEAR(std::sqrt(noise.squaredNorm() / 8000), 0.1, 4e-3);
  EXPECT_NEAR(noise.mean(), 0, 5e-3);
}

TEST(VanDerPolTest, RefusesWhatItCannotSimulate) {
  const auto diverging = SimulateWith({{"theta", "1000"}, {"x1_0", "10"}, {"x2_0", "10"}}, 100);
  EXPECT_EQ(diverging.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(diverging.status().message()),
              HasSubstr("system 0: the simulation diverges"));

  base::Executor* const executor = base::CallingThread();
  const auto with_input = Simulate(
      {.system = "van-der-pol", .input = RecordedInput{Eigen::MatrixXd::Zero(1, 9)}}, *executor);
  EXPECT_THAT(std::string(with_input.status().message()), HasSubstr("van-der-pol takes no input"));
}

}  // namespace
}  // namespace metaekf::sim
