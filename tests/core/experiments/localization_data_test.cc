#include "core/experiments/localization_data.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <numbers>

namespace metaekf::experiments {
namespace {

using Eigen::MatrixXd;

TEST(LocalizationDataTest, DeadReckoningOfAVehicleThatDoesNotSlipIsItsPath) {
  const absl::StatusOr<sim::Fleet> fleet =
      sim::Simulate({.system = "magnetic-localization", .systems = 2, .seed = 3, .steps = 120}, *base::CallingThread());
  ASSERT_TRUE(fleet.ok()) << fleet.status();
  for (const Eigen::Index i : {0, 1}) {
    const data::Trajectory& recording = fleet->dataset.trajectories[static_cast<size_t>(i)];
    const MatrixXd truth = recording.states.rightCols(100);
    const auto error = [&](const sim::SingleTrack& geometry) { return SummedError(StateErrors(DeadReckoning(geometry, recording, 20), truth)); };
    EXPECT_LT(error(VehicleOf(*fleet, i).geometry), 1e-9);
    EXPECT_GT(error(AverageGeometry()), 1);
  }
}

TEST(LocalizationDataTest, VehiclesOfTheStudySlip) {
  const absl::StatusOr<sim::Fleet> fleet = Vehicles(1, 3, base::CallingThread());
  ASSERT_TRUE(fleet.ok()) << fleet.status();
  const data::Trajectory& recording = fleet->dataset.trajectories[0];
  ASSERT_EQ(recording.length(), kLocalizationSamples);
  double steps = 0;
  for (Eigen::Index t = 1; t < recording.length(); ++t) {
    const Eigen::Vector3d moved = VehicleOf(*fleet, 0).geometry.Move(recording.states.col(t - 1), recording.inputs.col(t - 1), 0.1);
    steps += (recording.states.col(t) - moved).head<2>().squaredNorm();
  }
  EXPECT_NEAR(std::sqrt(steps / (2 * 399)), 0.005, 0.0005);
}

TEST(LocalizationDataTest, HeadingsAreComparedAsAngles) {
  const MatrixXd truth{{1, 1}, {2, 2}, {3, -3}}, estimates{{1, 4}, {2, 6}, {3 + 2 * std::numbers::pi, -3}};
  const MatrixXd errors = StateErrors(estimates, truth);
  EXPECT_NEAR(errors.col(0).norm(), 0, 1e-12);
  EXPECT_NEAR(SummedError(errors), 5, 1e-12);
  EXPECT_TRUE(std::isinf(SummedError(MatrixXd::Constant(3, 1, std::numeric_limits<double>::quiet_NaN()))));
}

TEST(LocalizationDataTest, AFieldThatIsOffByAConstantIsOffByItEverywhere) {
  const sim::MagnetizedSphere sphere{.magnetization = {1, 1}, .radius_m = 3};
  FieldGrid field = FieldOf(sphere, 40);
  const FieldErrors none = CompareFields(field, sphere);
  EXPECT_EQ(none.everywhere + none.outside + none.near_the_path, 0);
  field.x.array() += 0.1;
  field.y.array() -= 0.1;
  const FieldErrors off = CompareFields(field, sphere);
  for (const double error : {off.everywhere, off.outside, off.near_the_path}) EXPECT_NEAR(error, 0.1, 1e-12);
}

TEST(LocalizationDataTest, AnErrorInsideTheSphereCountsInTheLastFigureOnly) {
  const sim::MagnetizedSphere sphere{.magnetization = {1, 1}, .radius_m = 3};
  FieldGrid field = FieldOf(sphere, 40);
  field.x(20, 20) += 1;  // 0.3 m from the middle
  const FieldErrors errors = CompareFields(field, sphere);
  EXPECT_NEAR(errors.everywhere, std::sqrt(1.0 / (2 * 1600)), 1e-12);
  EXPECT_EQ(errors.outside + errors.near_the_path, 0);
}

}  // namespace
}  // namespace metaekf::experiments
