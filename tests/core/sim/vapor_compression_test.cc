#include "core/sim/vapor_compression.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "core/base/rng.h"
#include "core/sim/simulate.h"

namespace metaekf::sim {
namespace {

using ::testing::HasSubstr;

absl::StatusOr<Fleet> SimulateWith(const std::map<std::string, std::string>& settings, int64_t steps, int64_t systems = 1) {
  return Simulate({.system = "vapor-compression", .systems = systems, .seed = 5, .steps = steps, .settings = settings},
                  *base::CallingThread());
}

/// Frequencies and valve positions as the family draws them.
Eigen::MatrixXd Inputs(Eigen::Index steps) {
  base::Rng rng(7);
  Eigen::MatrixXd inputs(2, steps);
  for (Eigen::Index t = 0; t < steps; ++t) {
    inputs.col(t) = t % 50 == 0 ? Eigen::Vector2d(rng.Uniform(40, 80), rng.Uniform(282, 312)) : Eigen::Vector2d(inputs.col(t - 1));
  }
  return inputs;
}

TEST(VaporCompressionTest, MassAndEnergyAreConserved) {
  for (const double length_m : {20.0, 40.0}) {
    const VaporCompressionRun run = SimulateVaporCompression(length_m, Inputs(1000), 50);
    ASSERT_TRUE(run.states.allFinite());
    EXPECT_LT((run.mass_kg.array() / run.mass_kg[0] - 1).abs().maxCoeff(), 1e-9);
    const Eigen::ArrayXd balance = run.energy_J.array() - run.energy_in_J.array() - run.energy_J[0];
    EXPECT_GT(run.energy_J.maxCoeff() - run.energy_J.minCoeff(), 5e3);
    EXPECT_LT(balance.abs().maxCoeff() / run.energy_J[0], 1e-9);
  }
}

TEST(VaporCompressionTest, PressuresFallAlongTheFlow) {
  const auto fleet = SimulateWith({}, 400, 6);
  ASSERT_TRUE(fleet.ok()) << fleet.status();
  for (const data::Trajectory& trajectory : fleet->dataset.trajectories) {
    for (int i = 0; i + 1 < kVaporCompressionVolumes; ++i) {
      EXPECT_GE((trajectory.states.row(i) - trajectory.states.row(i + 1)).minCoeff(), 0) << "volumes " << i << ", " << i + 1;
    }
  }
}

TEST(VaporCompressionTest, HalvingStepsChangesLittle) {
  const Eigen::MatrixXd inputs = Inputs(600);
  const Eigen::MatrixXd states = SimulateVaporCompression(30, inputs, 50).states;
  const Eigen::MatrixXd finer =
      SimulateVaporCompression(30, inputs, 50, 1e-7 / 8, kVaporCompressionSamplePeriodS / 2).states;
  EXPECT_LT(((states - finer).array().abs() / finer.array().abs()).maxCoeff(), 1e-4);
}

TEST(VaporCompressionTest, LooksLikeAnAirConditioner) {
  // 50 s of rest and 50 more: near the steady state. Condensing above the outdoor air of 35 °C, evaporating below the room's 27 °C,
  // superheated vapour to the compressor, subcooled or nearly so to the valve, compressed vapour hotter than any saturation.
  const VaporCompressionRun run =
      SimulateVaporCompression(30, Eigen::Vector2d(50, 300).replicate(1, 500), 50);
  const Eigen::VectorXd x = run.states.col(499);
  EXPECT_GT(x[0], 9e5);
  EXPECT_LT(x[0], 18e5);
  EXPECT_GT(x[7], 2e5);
  EXPECT_LT(x[7], 5.5e5);
  EXPECT_GT(x[15], 395e3);
  EXPECT_LT(x[11], 280e3);
  for (int i = 16; i < 20; ++i) EXPECT_GT(x[i], 308.15);
  for (int i = 20; i < 24; ++i) EXPECT_LT(x[i], 300.15);
  EXPECT_LT((run.states.col(499) - run.states.col(400)).cwiseQuotient(x).lpNorm<Eigen::Infinity>(), 0.01);
}

TEST(VaporCompressionTest, LengthsMakeDifferentMassesAndDynamics) {
  const VaporCompressionRun small = SimulateVaporCompression(20, Inputs(300), 50), large = SimulateVaporCompression(40, Inputs(300), 50);
  EXPECT_NEAR(large.mass_kg[0] / small.mass_kg[0], 2, 1e-9);  // the same initial state in twice the volume
  EXPECT_GT((large.states - small.states).row(0).cwiseAbs().maxCoeff(), 5e4);
}

TEST(VaporCompressionTest, MeasuresSixOfItsStates) {
  const auto clean = SimulateWith({}, 300), noisy = SimulateWith({{"pressure_noise_std", "2000"}, {"temperature_noise_std", "0.1"}}, 300);
  ASSERT_TRUE(clean.ok() && noisy.ok());
  const data::Trajectory& trajectory = clean->dataset.trajectories[0];
  ASSERT_EQ(trajectory.states.rows(), 24);
  const std::vector<Eigen::Index> measured = {0, 17, 19, 21, 7, 23};
  for (Eigen::Index i = 0; i < 6; ++i) EXPECT_EQ(trajectory.outputs.row(i), trajectory.states.row(measured[i]));
  EXPECT_EQ(noisy->dataset.trajectories[0].states, trajectory.states);
  const Eigen::MatrixXd noise = noisy->dataset.trajectories[0].outputs - trajectory.outputs;
  EXPECT_NEAR(std::sqrt(noise.row(0).squaredNorm() / 300), 2000, 300);
  EXPECT_NEAR(std::sqrt(noise.row(1).squaredNorm() / 300), 0.1, 0.015);
  EXPECT_GE(trajectory.inputs.row(0).minCoeff(), 40);
  EXPECT_LE(trajectory.inputs.row(1).maxCoeff(), 312);
  EXPECT_EQ(trajectory.inputs(0, 0), trajectory.inputs(0, 49));
  EXPECT_NE(trajectory.inputs(0, 49), trajectory.inputs(0, 50));
}

TEST(VaporCompressionTest, RefusesWhatItCannotSimulate) {
  EXPECT_THAT(std::string(SimulateWith({{"pipe_length", "-3"}}, 10).status().message()), HasSubstr("pipe_length is -3 m"));
  const auto record = [](double frequency, double counts, Hold hold) {
    const Eigen::MatrixXd values = Eigen::Vector2d(frequency, counts).replicate(1, 250);
    return std::string(Simulate({.system = "vapor-compression", .input = RecordedInput{.values = values, .hold = hold}},
                                *base::CallingThread())
                           .status()
                           .message());
  };
  EXPECT_THAT(record(50, 300, Hold::kLinear), HasSubstr("use the hold \"zero\""));
  EXPECT_THAT(record(-50, 300, Hold::kZero), HasSubstr("not positive"));
  // A compressor so fast, with a valve so wide, drives the condenser beyond the range of the refrigerant's equation.
  EXPECT_THAT(record(3000, 1e4, Hold::kZero), HasSubstr("the simulation diverges before"));
  EXPECT_EQ(record(50, 300, Hold::kZero), "");
}

}  // namespace
}  // namespace metaekf::sim
