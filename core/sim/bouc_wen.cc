#include "core/sim/bouc_wen.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/sim/runge_kutta.h"

namespace metaekf::sim {
namespace {

constexpr int kMaxHalvings = 12;

/// The force of one run, beginning with the warm-up.
struct Excitation {
  Signal force;
  Eigen::Index warmup;
  Eigen::Index steps;
};

absl::Status RefuseIdleOptions(const Settings& settings, const std::vector<std::string>& idle,
                               const std::string& excitation) {
  for (const std::string& option : idle) {
    if (!settings.IsSet(option)) continue;
    return absl::InvalidArgumentError(
        absl::StrCat(option, " has no effect on a ", excitation, "; leave it out"));
  }
  return absl::OkStatus();
}

absl::StatusOr<Excitation> MakeExcitation(const Run& run, base::Rng& rng) {
  const Settings& settings = run.settings;
  const bool starts_where_told =
      settings.IsSet("x1_0") || settings.IsSet("x2_0") || settings.IsSet("x3_0");
  const auto periods = static_cast<Eigen::Index>(
      settings.IsSet("warmup_periods") || !starts_where_told ? settings.Number("warmup_periods")
                                                             : 0);
  if (run.input != nullptr) {
    METAEKF_RETURN_IF_ERROR(RefuseIdleOptions(
        settings, {"excitation", "rms", "band_min", "band_max", "period", "amplitude", "frequency"},
        "recorded input"));
    const Eigen::Index length = run.input->values.cols();
    const std::vector<double> record(run.input->values.data(), run.input->values.data() + length);
    return Excitation{Signal::FromRecord(record, run.input->hold, kBoucWenSegmentsPerSample),
                      periods * length, run.steps.value_or(length)};
  }
  if (settings.Choice("excitation") == "sine") {
    METAEKF_RETURN_IF_ERROR(
        RefuseIdleOptions(settings, {"rms", "band_min", "band_max", "period"}, "sine"));
    const double cycles_per_sample = settings.Number("frequency") / kBoucWenSampleRateHz;
    const Eigen::Index steps = run.steps.value_or(10000);
    const auto warmup =
        static_cast<Eigen::Index>(std::ceil(static_cast<double>(periods) / cycles_per_sample));
    return Excitation{Signal::Sine(settings.Number("amplitude"), cycles_per_sample, -warmup,
                                   warmup + steps, kBoucWenSegmentsPerSample),
                      warmup, steps};
  }
  METAEKF_RETURN_IF_ERROR(RefuseIdleOptions(settings, {"amplitude", "frequency"}, "multisine"));
  const auto period = static_cast<Eigen::Index>(settings.Number("period"));
  METAEKF_ASSIGN_OR_RETURN(const std::vector<double> record,
                           DrawMultisine(settings.Number("band_min") / kBoucWenSampleRateHz,
                                         settings.Number("band_max") / kBoucWenSampleRateHz,
                                         settings.Number("rms"), period, rng));
  return Excitation{Signal::FromRecord(record, Hold::kBandLimited, kBoucWenSegmentsPerSample),
                    periods * period, run.steps.value_or(period)};
}

absl::StatusOr<data::Trajectory> SimulateRun(const Run& run, base::Rng& rng) {
  const std::vector<double>& p = run.parameters;
  const BoucWenParameters parameters = {p[0], p[1], p[2], p[3], p[4], p[5], p[6]};
  if (parameters.m_L <= 0) {
    return absl::InvalidArgumentError(
        absl::StrCat("m_L=", base::FormatShort(parameters.m_L), ": a mass must be positive"));
  }
  METAEKF_ASSIGN_OR_RETURN(const Excitation excitation, MakeExcitation(run, rng));
  const Eigen::Vector3d initial(run.settings.Number("x1_0"), run.settings.Number("x2_0"),
                                run.settings.Number("x3_0"));
  data::Trajectory trajectory;
  trajectory.sample_period_s = 1 / kBoucWenSampleRateHz;
  trajectory.states =
      SimulateBoucWen(parameters, excitation.force, initial, excitation.warmup, excitation.steps);
  METAEKF_RETURN_IF_ERROR(CheckStayedFinite(trajectory));
  trajectory.inputs.resize(1, excitation.steps);
  for (Eigen::Index t = 0; t < excitation.steps; ++t) {
    trajectory.inputs(0, t) = excitation.force.AtSample(excitation.warmup + t);
  }
  trajectory.outputs = trajectory.states.row(0);
  AddOutputNoise(run.settings, rng, trajectory);
  if (run.settings.Choice("states") == "0") trajectory.states.resize(0, excitation.steps);
  return trajectory;
}

std::vector<Option> Options() {
  return {
      NominalOption(),
      NoiseOption("m", "standard deviation of white noise on y; the paper's is 8e-6"),
      {.name = "excitation",
       .default_value = "multisine",
       .description = "the force: random-phase multisine, or a sine",
       .choices = {"multisine", "sine"}},
      {.name = "rms",
       .unit = "N",
       .default_value = "50",
       .description = "of the multisine",
       .min = 0},
      {.name = "band_min",
       .unit = "Hz",
       .default_value = "5",
       .description = "lowest frequency of the multisine",
       .min = 0,
       .max = kBoucWenSampleRateHz / 2},
      {.name = "band_max",
       .unit = "Hz",
       .default_value = "150",
       .description = "highest frequency of the multisine",
       .min = 0,
       .max = kBoucWenSampleRateHz / 2},
      {.name = "period",
       .unit = "samples",
       .default_value = "8192",
       .description = "of the multisine",
       .min = 2,
       .max = 1 << 22,
       .whole = true},
      {.name = "amplitude", .unit = "N", .default_value = "120", .description = "of the sine"},
      {.name = "frequency",
       .unit = "Hz",
       .default_value = "1",
       .description = "of the sine",
       .min = 1e-3,
       .max = kBoucWenSampleRateHz / 2},
      {.name = "warmup_periods",
       .default_value = "1",
       .description =
           "periods of the force (of a record: its length) simulated before recording; 0 "
           "unless set where an initial state is given",
       .min = 0,
       .max = 1000,
       .whole = true},
      {.name = "x1_0", .unit = "m", .default_value = "0", .description = "initial displacement"},
      {.name = "x2_0", .unit = "m/s", .default_value = "0", .description = "initial velocity"},
      {.name = "x3_0",
       .unit = "N",
       .default_value = "0",
       .description = "initial hysteretic force"},
      {.name = "states",
       .default_value = "0",
       .description = "1: write the states too",
       .choices = {"0", "1"}}};
}

}  // namespace

Eigen::MatrixXd SimulateBoucWen(const BoucWenParameters& parameters, const Signal& input,
                                const Eigen::Vector3d& initial, Eigen::Index warmup,
                                Eigen::Index steps, double tolerance_m) {
  const BoucWenParameters p = parameters;
  const int segments = input.segments_per_sample();
  Quartic force{};
  const double steps_per_s = kBoucWenSampleRateHz * segments;
  const double step_s = 1 / steps_per_s;
  const double inverse_mass = 1 / p.m_L;
  const auto field = [&](double time_s, const Eigen::Vector3d& x) {
    const double u = force(time_s * steps_per_s);
    return Eigen::Vector3d(x[1], (u - p.k_L * x[0] - p.c_L * x[1] - x[2]) * inverse_mass,
                           p.alpha * x[1] - p.beta * (p.gamma * std::abs(x[1]) * x[2] +
                                                      p.delta * x[1] * std::abs(x[2])));
  };
  // Velocity and force as the displacements that they amount to; relative to motions beyond a
  // metre, where the tolerance would be below rounding.
  const double stiffness = std::max(1.0, std::abs(p.k_L) + std::abs(p.alpha));
  const Eigen::Array3d displacement(1, std::sqrt(p.m_L / stiffness), 1 / stiffness);
  const auto distance = [&displacement](const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
    return ((a - b).array() * displacement).abs().sum() /
           (1 + (b.array() * displacement).abs().sum());
  };

  Eigen::MatrixXd states =
      Eigen::MatrixXd::Constant(3, steps, std::numeric_limits<double>::quiet_NaN());
  Eigen::Vector3d x = initial;
  // Without the second test a run that diverged would go on, every step refined in vain.
  for (Eigen::Index t = 0; t < warmup + steps && x.allFinite(); ++t) {
    if (t >= warmup) states.col(t - warmup) = x;
    for (int segment = 0; segment < segments; ++segment) {
      force = input.Segment(t, segment);
      const Eigen::Vector3d whole = RungeKuttaStep(field, 0.0, x, step_s);
      x = RefineStep(field, 0.0, x, step_s, whole, distance, tolerance_m, kMaxHalvings);
    }
  }
  return states;
}

const System& BoucWen() {
  static const System system = {
      .name = "bouc-wen",
      .description = "Bouc–Wen hysteretic oscillators; only the displacement is measured",
      .sample_period_s = 1 / kBoucWenSampleRateHz,
      .default_length =
          "one period of the multisine, 10000 samples of the sine, or the whole record",
      .input_names = {"u1"},
      .output_names = {"y1"},
      .state_names = {"x1", "x2", "x3"},
      .parameters = {{"m_L", "kg", 1, 3, 2, "mass"},
                     {"c_L", "N s/m", 5, 15, 10, "damping"},
                     {"k_L", "N/m", 2.5e4, 7.5e4, 5e4, "stiffness"},
                     {"alpha", "N/m", 2.5e4, 7.5e4, 5e4, "initial stiffness of the hysteresis"},
                     {"beta", "1/m", 500, 4500, 1000, "shape of the hysteresis loop"},
                     {"gamma", "", 0.5, 0.9, 0.8, "shape of the hysteresis loop"},
                     {"delta", "", -1.5, -0.5, -1.1, "shape of the hysteresis loop"}},
      .options = Options(),
      .simulate = SimulateRun};
  return system;
}

}  // namespace metaekf::sim
