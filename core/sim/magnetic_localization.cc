#include "core/sim/magnetic_localization.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "core/base/numbers.h"
#include "core/base/status.h"

namespace metaekf::sim {
namespace {

constexpr double kSamplePeriodS = 0.1;
constexpr Eigen::Index kDefaultSteps = 400;
constexpr double kSemiAxisX = 6, kSemiAxisY = 5;  // m, of the path
constexpr double kLateralAcceleration = 0.4;      // m/s²
constexpr double kLookAheadM = 1;
constexpr double kDegree = std::numbers::pi / 180;

/// Curvature of the path, 1/m.
double Curvature(double parameter) {
  const double s = kSemiAxisX * std::sin(parameter), c = kSemiAxisY * std::cos(parameter);
  return kSemiAxisX * kSemiAxisY / std::pow(s * s + c * c, 1.5);
}

/// Follows the path: finds the point to aim at from what has been reached so far.
class PurePursuit {
 public:
  PurePursuit(const SingleTrack& vehicle, double max_steering) : vehicle_(vehicle), max_steering_(max_steering) {}

  /// δ, ω_f, ω_r for a vehicle at `state`.
  Eigen::Vector3d Steer(const Eigen::Vector3d& state) {
    const Eigen::Vector2d heading(std::cos(state[2]), std::sin(state[2]));
    const Eigen::Vector2d rear = state.head<2>() - vehicle_.l_r_m * heading;
    // The nearest point goes forward along the path, never back, and the point aimed at lies a look-ahead beyond.
    constexpr double kStep = 0.005;
    while ((ReferencePath(nearest_ + kStep) - rear).norm() < (ReferencePath(nearest_) - rear).norm()) nearest_ += kStep;
    double aim = nearest_;
    while ((ReferencePath(aim) - ReferencePath(nearest_)).norm() < kLookAheadM) aim += kStep;
    const Eigen::Vector2d to_aim = ReferencePath(aim) - rear;
    const double side = heading[0] * to_aim[1] - heading[1] * to_aim[0];  // |to_aim| sin α
    const double length = vehicle_.l_f_m + vehicle_.l_r_m;
    const double wanted = std::atan(2 * length * side / to_aim.squaredNorm());
    const double steering = std::clamp(wanted, -max_steering_, max_steering_);
    const double speed = std::sqrt(kLateralAcceleration / Curvature(nearest_));
    // Both wheels roll without slip, the front one along its own direction; their mean speed is v_X.
    const double rear_speed = 2 * speed / (1 + 1 / std::cos(steering)) / kWheelRadiusM;
    return {steering, rear_speed / std::cos(steering), rear_speed};
  }

 private:
  SingleTrack vehicle_;
  double max_steering_;
  double nearest_ = 0;
};

absl::StatusOr<data::Trajectory> SimulateRun(const Run& run, base::Rng& rng) {
  const std::vector<double>& p = run.parameters;
  const SingleTrack vehicle{.l_f_m = p[0], .l_r_m = p[1]};
  const MagnetizedSphere sphere{.magnetization = {p[3], p[4]}, .radius_m = p[5]};
  const double max_steering_deg = p[2];
  if (!(vehicle.l_f_m + vehicle.l_r_m > 0)) return absl::InvalidArgumentError("l_f + l_r must be positive");
  if (!(max_steering_deg > 0 && max_steering_deg < 80)) {
    return absl::InvalidArgumentError(
        absl::StrCat("max_steering is ", base::FormatShort(max_steering_deg), " degrees; it must be between 0 and 80"));
  }
  if (!(sphere.radius_m > 0)) {
    return absl::InvalidArgumentError(absl::StrCat("r_0 is ", base::FormatShort(sphere.radius_m), " m; it must be positive"));
  }
  Eigen::Index steps = run.steps.value_or(kDefaultSteps);
  if (run.input != nullptr) {
    METAEKF_ASSIGN_OR_RETURN(steps, StepsOfHeldInput(run));
  }
  const double position_std = run.settings.Number("position_std"), heading_std = run.settings.Number("heading_std");
  const double noise_std = run.settings.Number("noise_std");
  data::Trajectory trajectory;
  trajectory.sample_period_s = kSamplePeriodS;
  trajectory.inputs.resize(3, steps);
  trajectory.states.resize(3, steps);
  trajectory.outputs.resize(2, steps);
  PurePursuit controller(vehicle, max_steering_deg * kDegree);
  Eigen::Vector3d state(ReferencePath(0)[0] + p[6], ReferencePath(0)[1] + p[7], std::numbers::pi / 2 + p[8]);
  for (Eigen::Index t = 0; t < steps; ++t) {
    const Eigen::Vector3d input = run.input != nullptr ? Eigen::Vector3d(run.input->values.col(t)) : controller.Steer(state);
    trajectory.states.col(t) = state;
    trajectory.inputs.col(t) = input;
    const Eigen::Vector2d noise(rng.Normal(), rng.Normal());
    trajectory.outputs.col(t) = sphere.FieldAt(state.head<2>()) + noise_std * noise;
    const Eigen::Vector3d slip(position_std * rng.Normal(), position_std * rng.Normal(), heading_std * rng.Normal());
    state = vehicle.Move(state, input, kSamplePeriodS) + slip;
  }
  METAEKF_RETURN_IF_ERROR(CheckStayedFinite(trajectory));
  return trajectory;
}

}  // namespace

Eigen::Vector2d MagnetizedSphere::FieldAt(const Eigen::Vector2d& position_m) const {
  const double r = position_m.norm();
  if (r < radius_m) return -magnetization / 3;
  const Eigen::Vector2d direction = position_m / r;
  const double fall = radius_m / r;
  return fall * fall * fall / 3 * (3 * magnetization.dot(direction) * direction - magnetization);
}

Eigen::Vector3d SingleTrack::Move(const Eigen::Vector3d& state, const Eigen::Vector3d& input, double duration_s) const {
  const double length = l_f_m + l_r_m, slope = std::tan(input[0]);
  const double speed = (input[1] + input[2]) * kWheelRadiusM / 2;
  const double slip_angle = std::atan(l_r_m * slope / length);
  const double turn = speed * slope / length * duration_s;
  // A body that turns at a constant rate moves along the chord of an arc, at half the turn.
  const double half = turn / 2;
  const double chord = speed * duration_s / std::cos(slip_angle) * (std::abs(half) < 1e-4 ? 1 - half * half / 6 : std::sin(half) / half);
  const double direction = state[2] + slip_angle + half;
  return {state[0] + chord * std::cos(direction), state[1] + chord * std::sin(direction), state[2] + turn};
}

Eigen::Vector2d ReferencePath(double parameter) {
  return {kSemiAxisX * std::cos(parameter), kSemiAxisY * std::sin(parameter)};
}

double AngleBetween(double a, double b) {
  const double turn = std::remainder(a - b, 2 * std::numbers::pi);
  return turn == -std::numbers::pi ? std::numbers::pi : turn;
}

const System& MagneticLocalization() {
  static const System system = {
      .name = "magnetic-localization",
      .description = "vehicles (position m, heading rad; inputs steering angle rad, wheel speeds rad/s) that measure the field (A/m) of a "
                     "magnetized sphere",
      .sample_period_s = kSamplePeriodS,
      .default_length = "40 s, or the whole record",
      .input_names = {"u1", "u2", "u3"},
      .output_names = {"y1", "y2"},
      .state_names = {"x1", "x2", "x3"},
      .parameters = {{"l_f", "m", 0.02, 0.25, 0.135, "distance to the front axle"},
                     {"l_r", "m", 0.02, 0.25, 0.135, "distance to the rear axle"},
                     {"max_steering", "deg", 10, 20, 15, "largest steering angle"},
                     {"m_X", "A/m", -1.5, 1.5, 1, "magnetization along X"},
                     {"m_Y", "A/m", -1.5, 1.5, 1, "magnetization along Y"},
                     {"r_0", "m", 1.5, 4.5, 3, "radius of the sphere"},
                     {"x1_0", "m", -0.2, 0.2, 0, "initial distance from the path's first point, X"},
                     {"x2_0", "m", -0.2, 0.2, 0, "the same, Y"},
                     {"x3_0", "rad", -0.1, 0.1, 0, "initial heading off the path's"}},
      .options = {NominalOption(), NoiseOption("A/m", "standard deviation of white noise on the field"),
                  {.name = "position_std", .unit = "m", .default_value = "0",
                   .description = "standard deviation of the position's process noise, each sample", .min = 0},
                  {.name = "heading_std", .unit = "rad", .default_value = "0",
                   .description = "standard deviation of the heading's process noise, each sample", .min = 0}},
      .simulate = SimulateRun};
  return system;
}

}  // namespace metaekf::sim
