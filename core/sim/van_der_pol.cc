#include "core/sim/van_der_pol.h"

#include <cmath>

#include "core/base/status.h"

namespace metaekf::sim {
namespace {

constexpr double kSamplePeriodS = 0.01;

absl::StatusOr<data::Trajectory> SimulateVanDerPol(const Run& run, base::Rng& rng) {
  const double theta = run.parameters[0];
  // Drawn even where it is not used, so that the noise of a system does not depend on who chose its
  // length.
  const double duration_s = rng.Uniform(10, 40);
  const Eigen::Index steps =
      run.steps.value_or(static_cast<Eigen::Index>(std::round(duration_s / kSamplePeriodS)));
  data::Trajectory trajectory;
  trajectory.sample_period_s = kSamplePeriodS;
  trajectory.inputs.resize(0, steps);
  trajectory.states.resize(2, steps);
  trajectory.states.col(0) << run.parameters[1], run.parameters[2];
  for (Eigen::Index t = 0; t + 1 < steps; ++t) {
    const double x1 = trajectory.states(0, t);
    const double x2 = trajectory.states(1, t);
    trajectory.states(0, t + 1) = x1 + kSamplePeriodS * x2;
    trajectory.states(1, t + 1) = x2 + kSamplePeriodS * (theta * x2 * (1 - x1 * x1) - x1);
  }
  METAEKF_RETURN_IF_ERROR(CheckStayedFinite(trajectory));
  trajectory.outputs = trajectory.states;
  AddOutputNoise(run.settings, rng, trajectory);
  return trajectory;
}

}  // namespace

const System& VanDerPol() {
  static const System system = {
      .name = "van-der-pol",
      .description = "unforced van der Pol oscillators; both states are measured",
      .sample_period_s = kSamplePeriodS,
      .default_length = "10 to 40 s, drawn for each system",
      .output_names = {"y1", "y2"},
      .state_names = {"x1", "x2"},
      .parameters = {{"theta", "", 0.5, 2, 1.572, "damping"},
                     {"x1_0", "", -1, 1, 1, "initial x1"},
                     {"x2_0", "", -1, 1, -0.5, "initial x2"}},
      .options = {NominalOption(), NoiseOption("", "standard deviation of white noise on y")},
      .simulate = SimulateVanDerPol};
  return system;
}

}  // namespace metaekf::sim
