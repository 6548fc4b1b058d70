#include "core/data/normaliser.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "core/base/rng.h"

namespace metaekf::data {
namespace {

using ::testing::HasSubstr;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

/// Two trajectories with one input, two outputs and two states.
Dataset Small() {
  Dataset dataset{{"u1"}, {"y1", "y2"}, {"x1", "x2"}, {}};
  Trajectory a{"a", 0, 1, {}, {}, {}};
  a.inputs = (Eigen::MatrixXd(1, 2) << 1, 2).finished();
  a.outputs = (Eigen::MatrixXd(2, 2) << 0, 4, kNan, 10).finished();
  a.states = (Eigen::MatrixXd(2, 2) << 0, 6, 1, 1).finished();
  Trajectory b{"b", 0, 1, {}, {}, {}};
  b.inputs = (Eigen::MatrixXd(1, 1) << 6).finished();
  b.outputs = (Eigen::MatrixXd(2, 1) << 2, 20).finished();
  b.states = (Eigen::MatrixXd(2, 1) << 3, 1).finished();
  dataset.trajectories = {a, b};
  return dataset;
}

TEST(NormaliserTest, FitsMeanAndDeviationOverAllTrajectories) {
  const auto normaliser = FitNormaliser(Small());
  ASSERT_TRUE(normaliser.ok()) << normaliser.status();
  // By hand: u = 1, 2, 6; y1 = 0, 4, 2; y2 = 10, 20 without the missing one; x1 = 0, 6, 3; x2
  // constant.
  EXPECT_DOUBLE_EQ(normaliser->inputs.mean[0], 3);
  EXPECT_DOUBLE_EQ(normaliser->inputs.scale[0], std::sqrt((4.0 + 1 + 9) / 3));
  EXPECT_DOUBLE_EQ(normaliser->outputs.mean[0], 2);
  EXPECT_DOUBLE_EQ(normaliser->outputs.scale[0], std::sqrt(8.0 / 3));
  EXPECT_DOUBLE_EQ(normaliser->outputs.mean[1], 15);
  EXPECT_DOUBLE_EQ(normaliser->outputs.scale[1], 5);
  EXPECT_DOUBLE_EQ(normaliser->states.scale[0], std::sqrt(6.0));
  EXPECT_DOUBLE_EQ(normaliser->states.mean[1], 1);
  EXPECT_DOUBLE_EQ(normaliser->states.scale[1], 1);
}

TEST(NormaliserTest, AGroupSharesOneScaleAndKeepsItsMeans) {
  const auto normaliser = FitNormaliser(
      Small(), {ScaleGroup{.outputs = {0, 1}}, ScaleGroup{.inputs = {0}, .states = {1, 0}}});
  ASSERT_TRUE(normaliser.ok()) << normaliser.status();
  // By hand: squared deviations 8 of three values and 50 of two; 14, 18 and 0 of three each.
  EXPECT_DOUBLE_EQ(normaliser->outputs.scale[0], std::sqrt(58.0 / 5));
  EXPECT_EQ(normaliser->outputs.scale[1], normaliser->outputs.scale[0]);
  EXPECT_DOUBLE_EQ(normaliser->outputs.mean[0], 2);
  EXPECT_DOUBLE_EQ(normaliser->outputs.mean[1], 15);
  EXPECT_DOUBLE_EQ(normaliser->states.scale[0], std::sqrt(32.0 / 9));
  EXPECT_EQ(normaliser->states.scale[1], normaliser->states.scale[0]);
  EXPECT_EQ(normaliser->inputs.scale[0], normaliser->states.scale[0]);
}

TEST(NormaliserTest, AConstantIsRecognisedThroughRounding) {
  Dataset dataset{{}, {"y1", "y2"}, {}, {Trajectory{"a", 0, 1, {}, {}, {}}}};
  Trajectory& trajectory = dataset.trajectories[0];
  trajectory.inputs.resize(0, 1000);
  trajectory.states.resize(0, 1000);
  trajectory.outputs = Eigen::MatrixXd::Constant(2, 1000, 293.15);
  trajectory.outputs(0, 5) = std::nextafter(293.15, 300.0);
  trajectory.outputs.row(1).setLinSpaced(293.15, 293.15 + 1e-6);
  const auto normaliser = FitNormaliser(dataset);
  ASSERT_TRUE(normaliser.ok());
  EXPECT_EQ(normaliser->outputs.scale[0], 1);
  // A uniform spread of 1e-6 has deviation 1e-6 / √12 and is a signal, not rounding.
  EXPECT_NEAR(normaliser->outputs.scale[1], 1e-6 / std::sqrt(12.0), 1e-9);
}

TEST(NormaliserTest, NormalisedDataHasMeanZeroAndDeviationOneAndComesBack) {
  base::Rng rng(5);
  Dataset dataset{{"u1"}, {"y1"}, {"x1", "x2"}, {}};
  for (int i = 0; i < 3; ++i) {
    Trajectory& trajectory = dataset.trajectories.emplace_back();
    const auto random = [&rng](Eigen::Index rows, double mean, double deviation) {
      return Eigen::MatrixXd(
          Eigen::MatrixXd::NullaryExpr(rows, 400, [&] { return mean + deviation * rng.Normal(); }));
    };
    trajectory.name = std::to_string(i);
    trajectory.sample_period_s = 0.1;
    trajectory.inputs = random(1, 0, 50);
    trajectory.outputs = random(1, 1e-3, 6e-4);
    trajectory.states = random(2, 1e5, 1);
  }
  const auto normaliser = FitNormaliser(dataset);
  ASSERT_TRUE(normaliser.ok());
  double sum = 0, sum_of_squares = 0;
  for (const Trajectory& trajectory : dataset.trajectories) {
    const auto normalised = Normalised(*normaliser, trajectory);
    ASSERT_TRUE(normalised.ok());
    EXPECT_EQ(normalised->name, trajectory.name);
    EXPECT_EQ(normalised->sample_period_s, 0.1);
    sum += normalised->states.row(1).sum();
    sum_of_squares += normalised->states.row(1).squaredNorm();
    const auto back = Denormalised(*normaliser, *normalised);
    ASSERT_TRUE(back.ok());
    EXPECT_TRUE(back->inputs.isApprox(trajectory.inputs, 1e-14));
    EXPECT_TRUE(back->outputs.isApprox(trajectory.outputs, 1e-14));
    EXPECT_TRUE(back->states.isApprox(trajectory.states, 1e-14));
  }
  EXPECT_NEAR(sum / 1200, 0, 1e-9);
  EXPECT_NEAR(sum_of_squares / 1200, 1, 1e-9);
}

TEST(NormaliserTest, MissingOutputsStayMissing) {
  const Dataset dataset = Small();
  const auto normalised = Normalised(*FitNormaliser(dataset), dataset.trajectories[0]);
  ASSERT_TRUE(normalised.ok());
  EXPECT_TRUE(std::isnan(normalised->outputs(1, 0)));
  EXPECT_DOUBLE_EQ(normalised->outputs(1, 1), -1);
}

TEST(NormaliserTest, RefusesDataThatCannotBeFitted) {
  const auto error_of = [](const auto& change) {
    Dataset dataset = Small();
    change(dataset);
    const auto normaliser = FitNormaliser(dataset);
    EXPECT_EQ(normaliser.status().code(), absl::StatusCode::kInvalidArgument);
    return std::string(normaliser.status().message());
  };
  EXPECT_THAT(error_of([](Dataset& d) { d.trajectories.clear(); }), HasSubstr("no sample"));
  EXPECT_THAT(error_of([](Dataset& d) { d.trajectories[1].inputs(0, 0) = kNan; }),
              HasSubstr("trajectory b, sample 0, u1: nan"));
  EXPECT_THAT(error_of([](Dataset& d) { d.trajectories[0].outputs(0, 1) = HUGE_VAL; }),
              HasSubstr("trajectory a, sample 1, y1: inf"));
  EXPECT_THAT(error_of([](Dataset& d) {
                for (Trajectory& t : d.trajectories) t.outputs.row(1).setConstant(kNan);
              }),
              HasSubstr("y2 has no value"));
  EXPECT_THAT(error_of([](Dataset& d) { d.state_names.pop_back(); }),
              HasSubstr("2 × 2 values, expected 1 × 2"));
}

TEST(NormaliserTest, RefusesGroupsThatDoNotFit) {
  const auto error_of = [](const std::vector<ScaleGroup>& groups) {
    return std::string(FitNormaliser(Small(), groups).status().message());
  };
  EXPECT_THAT(error_of({ScaleGroup{.outputs = {2}}}), HasSubstr("output 2, of 2"));
  EXPECT_THAT(error_of({ScaleGroup{.inputs = {-1}}}), HasSubstr("input -1"));
  EXPECT_THAT(error_of({ScaleGroup{.states = {0}}, ScaleGroup{.states = {1, 0}}}),
              HasSubstr("state 0, which is in a group already"));
}

TEST(NormaliserTest, RefusesATrajectoryWithOtherChannels) {
  const Dataset dataset = Small();
  const auto normaliser = FitNormaliser(dataset);
  Trajectory other = dataset.trajectories[0];
  other.states.conservativeResize(1, Eigen::NoChange);
  EXPECT_EQ(Normalised(*normaliser, other).status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(Denormalised(*normaliser, other).status().code(), absl::StatusCode::kInvalidArgument);
}

}  // namespace
}  // namespace metaekf::data
