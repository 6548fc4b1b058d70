#include "core/sim/magnetic_localization.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <numbers>

#include "core/sim/runge_kutta.h"
#include "core/sim/simulate.h"

namespace metaekf::sim {
namespace {

using ::testing::HasSubstr;

absl::StatusOr<Fleet> SimulateWith(const std::map<std::string, std::string>& settings, int64_t steps = 400, int64_t systems = 1) {
  return Simulate({.system = "magnetic-localization", .systems = systems, .seed = 2, .steps = steps, .settings = settings},
                  *base::CallingThread());
}

TEST(MagneticLocalizationTest, TheFieldIsADipolesOutsideAndUniformInside) {
  const MagnetizedSphere sphere{.magnetization = {1.2, -0.6}, .radius_m = 2};
  EXPECT_LT((sphere.FieldAt({0.5, 1.0}) - Eigen::Vector2d(-0.4, 0.2)).norm(), 1e-15);
  // By hand on the X axis at twice the radius: (1/8)(1/3)(3 m_X − m_X, −m_Y).
  EXPECT_LT((sphere.FieldAt({4, 0}) - Eigen::Vector2d(2.4, 0.6) / 24).norm(), 1e-15);
  // What crosses the surface is continuous in H's tangential part, and in B = H + M across it: (H₂ − H₁)·n = M·n.
  for (const double angle : {0.3, 2.0, 4.4}) {
    const Eigen::Vector2d normal(std::cos(angle), std::sin(angle)), tangent(-std::sin(angle), std::cos(angle));
    const Eigen::Vector2d inside = sphere.FieldAt(2 * (1 - 1e-12) * normal), outside = sphere.FieldAt(2 * (1 + 1e-12) * normal);
    EXPECT_NEAR(inside.dot(tangent), outside.dot(tangent), 1e-11);
    EXPECT_NEAR((outside - inside).dot(normal), sphere.magnetization.dot(normal), 1e-11);
  }
}

TEST(MagneticLocalizationTest, TheFieldIsCurlFree) {
  const MagnetizedSphere sphere{.magnetization = {1.2, -0.6}, .radius_m = 1.5};
  for (double angle = 0; angle < 6; angle += 0.37) {
    const Eigen::Vector2d p = (2 + angle / 3) * Eigen::Vector2d(std::cos(angle), std::sin(angle));
    constexpr double kStep = 1e-5;
    const double dy_dX = (sphere.FieldAt(p + Eigen::Vector2d(kStep, 0))[1] - sphere.FieldAt(p - Eigen::Vector2d(kStep, 0))[1]) / (2 * kStep);
    const double dx_dY = (sphere.FieldAt(p + Eigen::Vector2d(0, kStep))[0] - sphere.FieldAt(p - Eigen::Vector2d(0, kStep))[0]) / (2 * kStep);
    EXPECT_NEAR(dy_dX, dx_dY, 1e-9);
  }
}

TEST(MagneticLocalizationTest, VehiclesMoveAsTheirEquationsSay) {
  const SingleTrack vehicle{.l_f_m = 0.2, .l_r_m = 0.1};
  for (const double steering : {0.0, 1e-7, -0.3, 0.2}) {
    const Eigen::Vector3d input(steering, 31, 29), start(1, -2, 0.7);
    const auto field = [&](double, const Eigen::Vector3d& x) {
      const double slip = std::atan(vehicle.l_r_m * std::tan(steering) / 0.3), speed = 30 * kWheelRadiusM;
      return Eigen::Vector3d(speed * std::cos(x[2] + slip) / std::cos(slip), speed * std::sin(x[2] + slip) / std::cos(slip),
                             speed * std::tan(steering) / 0.3);
    };
    Eigen::Vector3d x = start;
    for (int i = 0; i < 200; ++i) x = RungeKuttaStep(field, 0.0, x, 0.002);
    EXPECT_LT((vehicle.Move(start, input, 0.4) - x).norm(), 1e-10) << steering;
  }
}

TEST(MagneticLocalizationTest, VehiclesFollowThePathWhereTheFieldIsFelt) {
  const auto fleet = SimulateWith({{"position_std", "0.005"}, {"heading_std", "0.01"}}, 400, 40);
  ASSERT_TRUE(fleet.ok()) << fleet.status();
  for (size_t i = 0; i < 40; ++i) {
    const data::Trajectory& trajectory = fleet->dataset.trajectories[i];
    const double r_0 = fleet->parameters.values(static_cast<Eigen::Index>(i), 5);
    for (Eigen::Index t = 0; t < 400; ++t) {
      const Eigen::Vector2d p = trajectory.states.col(t).head<2>();
      EXPECT_GT(p.norm(), r_0);
      // The value of the ellipse's equation is 1 on the path; 0.2 off is half a metre.
      EXPECT_NEAR(std::hypot(p[0] / 6, p[1] / 5), 1, 0.12) << i << " at " << t;
    }
    // 1.5 m/s on a lap of 34.6 m: more than a turn, less than two.
    EXPECT_GT(trajectory.states(2, 399) - trajectory.states(2, 0), 2 * std::numbers::pi);
    EXPECT_LT(trajectory.states(2, 399) - trajectory.states(2, 0), 4 * std::numbers::pi);
  }
}

TEST(MagneticLocalizationTest, NoiseActsWhereItIsAskedFor) {
  const auto clean = SimulateWith({}), noisy = SimulateWith({{"noise_std", "0.01"}}), slipping = SimulateWith({{"heading_std", "0.02"}});
  ASSERT_TRUE(clean.ok() && noisy.ok() && slipping.ok());
  const data::Trajectory& quiet = clean->dataset.trajectories[0];
  EXPECT_EQ(noisy->dataset.trajectories[0].states, quiet.states);
  EXPECT_NEAR(std::sqrt((noisy->dataset.trajectories[0].outputs - quiet.outputs).squaredNorm() / 800), 0.01, 1e-3);
  // One step of the slipping vehicle against the equations, from its own record.
  const data::Trajectory& slipped = slipping->dataset.trajectories[0];
  const Eigen::MatrixXd& p = slipping->parameters.values;
  double squares = 0;
  for (Eigen::Index t = 0; t + 1 < 400; ++t) {
    const Eigen::Vector3d expected = SingleTrack{p(0, 0), p(0, 1)}.Move(slipped.states.col(t), slipped.inputs.col(t), 0.1);
    EXPECT_LT((slipped.states.col(t + 1) - expected).head<2>().norm(), 1e-12);
    squares += std::pow(slipped.states(2, t + 1) - expected[2], 2);
  }
  EXPECT_NEAR(std::sqrt(squares / 399), 0.02, 0.002);
}

TEST(MagneticLocalizationTest, AnglesAreComparedOnTheCircle) {
  EXPECT_NEAR(AngleBetween(0.1, 2 * std::numbers::pi - 0.1), 0.2, 1e-14);
  EXPECT_NEAR(AngleBetween(-3, 3), 2 * std::numbers::pi - 6, 1e-14);
  EXPECT_EQ(AngleBetween(std::numbers::pi, 0), std::numbers::pi);
  EXPECT_EQ(AngleBetween(-std::numbers::pi, 0), std::numbers::pi);
}

TEST(MagneticLocalizationTest, RefusesWhatItCannotSimulate) {
  const auto error = [](const std::string& name, const std::string& value) {
    return std::string(SimulateWith({{name, value}}, 5).status().message());
  };
  EXPECT_THAT(error("r_0", "-1"), HasSubstr("r_0 is -1 m"));
  EXPECT_THAT(error("max_steering", "95"), HasSubstr("max_steering is 95 degrees"));
  EXPECT_THAT(error("l_f", "-1"), HasSubstr("l_f + l_r must be positive"));
}

}  // namespace
}  // namespace metaekf::sim
