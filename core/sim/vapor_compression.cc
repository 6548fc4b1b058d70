#include "core/sim/vapor_compression.h"

#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <optional>

#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/sim/r134a.h"

namespace metaekf::sim {
namespace {

constexpr int kVolumes = kVaporCompressionVolumes, kStates = 3 * kVolumes, kCondenser = kVolumes / 2;
constexpr double kPipeDiameterM = 8e-3;
constexpr double kWallHeatPerMetre = 200;                               // J/(K m), pipe and fins
constexpr double kAirConductancePerMetre[2] = {25, 16};                 // W/(K m) from wall to air: condenser, evaporator
constexpr double kAirCapacityFlow[2] = {800, 300};                      // W/K, ṁ_a c_a of the whole heat exchanger
constexpr double kAirTemperature[2] = {308.15, 300.15};                 // K, entering
constexpr double kLiquidFilm = 600, kBoilingFilm = 2500, kVapourFilm = 250;  // W/(m² K), from refrigerant to wall
constexpr double kFriction = 5.6e-5 * 5.477;                            // m² √m: k √L of one volume of pipe length L
constexpr double kValvePerCount = 2.75e-9;                              // m²
constexpr double kDisplacement = 33e-6;                                 // m³ per turn
constexpr double kClearance = 0.04, kPolytropic = 1.1, kEfficiency = 0.65;
constexpr double kSmallPressure = 50;                                   // Pa, below which flows are laminar
constexpr double kRestFrequencyHz = 50, kRestCounts = 300;
constexpr double kShortestStepS = 1e-7;
constexpr Eigen::Index kDefaultSteps = 5000;

using State = Eigen::Matrix<double, kStates, 1>;
using Square = Eigen::Matrix<double, kStates, kStates>;

/// Sizes of a step's unknowns: pressure, enthalpy, temperature.
State Scales() {
  State scales;
  scales << Eigen::Matrix<double, kVolumes, 1>::Constant(1e6), Eigen::Matrix<double, kVolumes, 1>::Constant(3e5),
      Eigen::Matrix<double, kVolumes, 1>::Constant(300);
  return scales;
}

/// The state that every cycle is started in.
State DefaultState() {
  State z;
  z.head<kVolumes>() << 10.0e5, 10.0e5, 10.0e5, 10.0e5, 4.0e5, 4.0e5, 4.0e5, 4.0e5;
  z.segment<kVolumes>(kVolumes) << 420e3, 360e3, 300e3, 250e3, 260e3, 310e3, 360e3, 402e3;
  z.tail<kVolumes>() << 312, 312, 312, 311, 283, 283, 283, 284;
  return z;
}

/// 0 up to `low`, 1 from `high`, with a smooth slope between.
double SmoothStep(double low, double high, double value) {
  const double s = std::clamp((value - low) / (high - low), 0.0, 1.0);
  return s * s * (3 - 2 * s);
}

double Film(double quality) {
  const double boiling = SmoothStep(-0.05, 0.10, quality), dry = SmoothStep(0.80, 1.05, quality);
  return kLiquidFilm + boiling * (kBoilingFilm - kLiquidFilm) + dry * (kVapourFilm - kBoilingFilm);
}

/// What the balances need to know of one volume's refrigerant.
struct Contents {
  double p, h, wall, density, temperature, quality;
};
using Loop = std::array<Contents, kVolumes>;

class Cycle {
 public:
  explicit Cycle(double pipe_length_m)
      : length_(pipe_length_m / kCondenser),
        volume_(std::numbers::pi / 4 * kPipeDiameterM * kPipeDiameterM * length_),
        area_(std::numbers::pi * kPipeDiameterM * length_),
        friction_(kFriction / std::sqrt(pipe_length_m)) {
    for (const int side : {0, 1}) {
      const double capacity_flow = kAirCapacityFlow[side] / kCondenser;
      air_conductance_[side] = capacity_flow * (1 - std::exp(-kAirConductancePerMetre[side] * length_ / capacity_flow));
    }
  }

  double volume() const { return volume_; }
  double wall_capacity() const { return kWallHeatPerMetre * length_; }

  void SetInputs(double frequency_Hz, double valve_counts) {
    frequency_ = frequency_Hz;
    valve_ = valve_counts;
  }

  /// d/dt of ρ, ρh − p and T, grouped as the states are. @return the power that comes in, W.
  double Rates(const Loop& loop, State* rates) const {
    std::array<double, kVolumes> flow{}, enthalpy{};  // out of volume i, into the next
    for (int i = 0; i + 1 < kVolumes; ++i) {
      const double fall = loop[i].p - loop[i + 1].p;
      const Contents& from = fall >= 0 ? loop[i] : loop[i + 1];
      const double k = i == kCondenser - 1 ? kValvePerCount * valve_ : friction_;
      flow[i] = k * std::sqrt(from.density) * fall / std::sqrt(std::sqrt(fall * fall + kSmallPressure * kSmallPressure));
      enthalpy[i] = from.h;
    }
    const Contents& suction = loop[kVolumes - 1];
    const double ratio = loop[0].p / suction.p;
    const double filling = 1 + kClearance - kClearance * std::pow(ratio, 1 / kPolytropic);
    constexpr double kExponent = (kPolytropic - 1) / kPolytropic;
    const double work = suction.p / suction.density / kExponent * (std::pow(ratio, kExponent) - 1) / kEfficiency;
    flow[kVolumes - 1] = filling * kDisplacement * frequency_ * suction.density;
    enthalpy[kVolumes - 1] = suction.h + work;

    double power = flow[kVolumes - 1] * work;
    for (int i = 0; i < kVolumes; ++i) {
      const int before = (i + kVolumes - 1) % kVolumes, side = i < kCondenser ? 0 : 1;
      const double to_refrigerant = Film(loop[i].quality) * area_ * (loop[i].wall - loop[i].temperature);
      const double from_air = air_conductance_[side] * (kAirTemperature[side] - loop[i].wall);
      const double out = i == kVolumes - 1 ? suction.h : enthalpy[i];
      (*rates)[i] = (flow[before] - flow[i]) / volume_;
      (*rates)[kVolumes + i] = (flow[before] * enthalpy[before] - flow[i] * out + to_refrigerant) / volume_;
      (*rates)[2 * kVolumes + i] = (from_air - to_refrigerant) / wall_capacity();
      power += from_air;
    }
    return power;
  }

 private:
  double length_, volume_, area_, friction_;
  double air_conductance_[2];
  double frequency_ = kRestFrequencyHz, valve_ = kRestCounts;
};

/// A state with all that follows from it.
struct Point {
  State z;          // unknowns
  State conserved;  // c(z)
  State rates;      // dc/dt
  double power = 0;
  std::array<r134a::Fluid, kVolumes> fluids;
};

Loop Contain(const Point& point) {
  Loop loop;
  for (int i = 0; i < kVolumes; ++i) {
    const r134a::Fluid& fluid = point.fluids[i];
    loop[i] = {.p = point.z[i], .h = point.z[kVolumes + i], .wall = point.z[2 * kVolumes + i],
               .density = fluid.density, .temperature = fluid.temperature, .quality = fluid.quality};
  }
  return loop;
}

Point Evaluate(const Cycle& cycle, const State& z) {
  Point point{.z = z};
  for (int i = 0; i < kVolumes; ++i) {
    const double p = z[i], h = z[kVolumes + i];
    point.fluids[i] = r134a::AtEnthalpy(p, h);
    point.conserved[i] = point.fluids[i].density;
    point.conserved[kVolumes + i] = point.fluids[i].density * h - p;
    point.conserved[2 * kVolumes + i] = z[2 * kVolumes + i];
  }
  point.power = cycle.Rates(Contain(point), &point.rates);
  return point;
}

/// ∂(c − weight · dc/dt)/∂z. The rates' part by differences along the exact derivatives of the refrigerant: it steers Newton's method,
/// whose result does not depend on it.
Square NewtonMatrix(const Cycle& cycle, const Point& point, double weight) {
  Square matrix = Square::Zero();
  Loop loop = Contain(point);
  const State scales = Scales();
  for (int k = 0; k < kStates; ++k) {
    const int i = k % kVolumes, kind = k / kVolumes;
    const Contents kept = loop[i];
    const r134a::Fluid& fluid = point.fluids[i];
    const double step = 1e-7 * scales[k];
    (kind == 0 ? loop[i].p : kind == 1 ? loop[i].h : loop[i].wall) += step;
    if (kind < 2) {
      loop[i].density += step * (kind == 0 ? fluid.drho_dp : fluid.drho_dh);
      loop[i].temperature += step * (kind == 0 ? fluid.dT_dp : fluid.dT_dh);
    }
    State moved;
    cycle.Rates(loop, &moved);
    matrix.col(k) = -weight / step * (moved - point.rates);
    loop[i] = kept;
    if (kind == 2) {
      matrix(k, k) += 1;
    } else {
      const double drho = kind == 0 ? fluid.drho_dp : fluid.drho_dh;
      matrix(i, k) += drho;
      matrix(kVolumes + i, k) += kept.h * drho + (kind == 0 ? -1 : kept.density);
    }
  }
  return matrix;
}

/// The point with c(z) = known + weight · dc/dt(z), from a guess; nothing where Newton's method does not get there.
std::optional<Point> SolveStage(const Cycle& cycle, const State& known, double weight, const State& guess) {
  const State scales = Scales();
  Point point = Evaluate(cycle, guess);
  for (int iteration = 0; iteration < 12; ++iteration) {
    const State residual = point.conserved - known - weight * point.rates;
    if (!residual.allFinite()) return std::nullopt;
    const State step = NewtonMatrix(cycle, point, weight).partialPivLu().solve(residual);
    point = Evaluate(cycle, point.z - step);
    if (step.cwiseQuotient(scales).lpNorm<Eigen::Infinity>() < 1e-8) {
      return point.rates.allFinite() ? std::optional(point) : std::nullopt;
    }
  }
  return std::nullopt;
}

/// One step of TR-BDF2 (R. E. Bank et al., IEEE Trans. CAD 4 (1985) 436), with the error estimate of M. E. Hosea and L. F. Shampine
/// (Appl. Numer. Math. 20 (1996) 21).
struct Step {
  Point end;
  double error;      // in tolerances of 1
  double energy_in;  // J
};

std::optional<Step> TakeStep(const Cycle& cycle, const Point& start, double step_s) {
  constexpr double kGamma = 2 - std::numbers::sqrt2, kOwn = kGamma / 2, kOther = std::numbers::sqrt2 / 4;
  const auto middle = SolveStage(cycle, start.conserved + kOwn * step_s * start.rates, kOwn * step_s, start.z);
  if (!middle) return std::nullopt;
  const State guess = start.z + (middle->z - start.z) / kGamma;
  const auto end =
      SolveStage(cycle, start.conserved + kOther * step_s * (start.rates + middle->rates), kOwn * step_s, guess);
  if (!end) return std::nullopt;
  const State error = step_s * ((kOther - (1 - kOther) / 3) * start.rates + (kOther - (3 * kOther + 1) / 3) * middle->rates +
                                (kOwn - kOwn / 3) * end->rates);
  // Solved with Newton's matrix: in the unknowns, and without what stiffness only exaggerates.
  const State in_unknowns = NewtonMatrix(cycle, *end, kOwn * step_s).partialPivLu().solve(error);
  return Step{*end, in_unknowns.cwiseQuotient(Scales()).lpNorm<Eigen::Infinity>(),
              step_s * (kOther * (start.power + middle->power) + kOwn * end->power)};
}

/// Goes on by one duration in as many steps as the tolerance asks. @param step_s  the last step, kept from call to call.
/// @return the energy that came in; nothing where the state leaves the range of the refrigerant's equation.
std::optional<double> Advance(const Cycle& cycle, double duration_s, double tolerance, double max_step_s, double* step_s,
                              Point* point) {
  *point = Evaluate(cycle, point->z);  // with the inputs of this duration
  double left = duration_s, energy_in = 0;
  while (left > 1e-12 * duration_s) {
    const double step = std::min({*step_s, left, max_step_s});
    const auto taken = TakeStep(cycle, *point, step);
    const double error = taken ? taken->error / tolerance : 1e3;
    if (error <= 1) {
      *point = taken->end;
      energy_in += taken->energy_in;
      left -= step;
    }
    const double proposed = step * std::clamp(0.85 / std::cbrt(std::max(error, 1e-9)), 0.1, 4.0);
    // A step that was cut short by the end of the duration says nothing against a longer one.
    *step_s = error <= 1 && step < *step_s ? std::max(*step_s, proposed) : proposed;
    *step_s = std::min(*step_s, max_step_s);
    if (*step_s < kShortestStepS) return std::nullopt;
  }
  return energy_in;
}

Eigen::MatrixXd DrawInputs(const Settings& settings, Eigen::Index steps, base::Rng& rng) {
  const auto hold = static_cast<Eigen::Index>(std::round(settings.Number("hold_s") / kVaporCompressionSamplePeriodS));
  Eigen::MatrixXd inputs(2, steps);
  for (Eigen::Index t = 0; t < steps; ++t) {
    const bool anew = t % hold == 0;
    inputs(0, t) = anew ? rng.Uniform(40, 80) : inputs(0, t - 1);
    inputs(1, t) = anew ? rng.Uniform(282, 312) : inputs(1, t - 1);
  }
  return inputs;
}

absl::StatusOr<data::Trajectory> SimulateRun(const Run& run, base::Rng& rng) {
  const double length_m = run.parameters[0];
  if (!(length_m > 0)) {
    return absl::InvalidArgumentError(absl::StrCat("pipe_length is ", base::FormatShort(length_m), " m; it must be positive"));
  }
  data::Trajectory trajectory;
  trajectory.sample_period_s = kVaporCompressionSamplePeriodS;
  if (run.input != nullptr) {
    METAEKF_ASSIGN_OR_RETURN(const Eigen::Index steps, StepsOfHeldInput(run));
    trajectory.inputs = run.input->values.leftCols(steps);
    if (trajectory.inputs.minCoeff() <= 0) {
      return absl::InvalidArgumentError("a recorded frequency or valve position is not positive");
    }
  } else {
    trajectory.inputs = DrawInputs(run.settings, run.steps.value_or(kDefaultSteps), rng);
  }
  trajectory.states = SimulateVaporCompression(length_m, trajectory.inputs, run.settings.Number("settle_s")).states;
  METAEKF_RETURN_IF_ERROR(CheckStayedFinite(trajectory));
  constexpr std::array<Eigen::Index, 6> kMeasured = {0, 17, 19, 21, 7, 23};  // p1, T2, T4, T6, p8, T8
  const double noise_std[2] = {run.settings.Number("pressure_noise_std"), run.settings.Number("temperature_noise_std")};
  trajectory.outputs.resize(6, trajectory.states.cols());
  for (Eigen::Index t = 0; t < trajectory.states.cols(); ++t) {
    for (size_t i = 0; i < kMeasured.size(); ++i) {
      const bool pressure = kMeasured[i] < kVolumes;
      trajectory.outputs(static_cast<Eigen::Index>(i), t) =
          trajectory.states(kMeasured[i], t) + noise_std[pressure ? 0 : 1] * rng.Normal();
    }
  }
  return trajectory;
}

std::vector<std::string> StateNames() {
  std::vector<std::string> names;
  for (int i = 1; i <= kStates; ++i) names.push_back(absl::StrCat("x", i));
  return names;
}

}  // namespace

VaporCompressionRun SimulateVaporCompression(double pipe_length_m, const Eigen::MatrixXd& inputs, double settle_s,
                                             double tolerance, double max_step_s) {
  const Eigen::Index steps = inputs.cols();
  VaporCompressionRun run{.states = Eigen::MatrixXd::Constant(kStates, steps, std::numeric_limits<double>::quiet_NaN()),
                          .mass_kg = Eigen::VectorXd::Zero(steps),
                          .energy_J = Eigen::VectorXd::Zero(steps),
                          .energy_in_J = Eigen::VectorXd::Zero(steps)};
  Cycle cycle(pipe_length_m);
  Point point = Evaluate(cycle, DefaultState());
  double step_s = 1e-4, energy_in = 0;
  if (settle_s > 0 && !Advance(cycle, settle_s, tolerance, max_step_s, &step_s, &point)) return run;
  for (Eigen::Index t = 0; t < steps; ++t) {
    run.states.col(t) = point.z;
    run.mass_kg[t] = cycle.volume() * point.conserved.head<kVolumes>().sum();
    run.energy_J[t] = cycle.volume() * point.conserved.segment<kVolumes>(kVolumes).sum() +
                      cycle.wall_capacity() * point.conserved.tail<kVolumes>().sum();
    run.energy_in_J[t] = energy_in;
    if (t + 1 == steps) break;
    cycle.SetInputs(inputs(0, t), inputs(1, t));
    const auto added = Advance(cycle, kVaporCompressionSamplePeriodS, tolerance, max_step_s, &step_s, &point);
    if (!added) break;
    energy_in += *added;
  }
  return run;
}

const System& VaporCompression() {
  static const System system = {
      .name = "vapor-compression",
      .description = "vapor-compression cycles with R134a and unknown mass of refrigerant: pressures (Pa), enthalpies (J/kg) and wall "
                     "temperatures (K) of eight volumes, six of them measured",
      .sample_period_s = kVaporCompressionSamplePeriodS,
      .default_length = "500 s, or the whole record",
      .input_names = {"u1", "u2"},
      .output_names = {"y1", "y2", "y3", "y4", "y5", "y6"},
      .state_names = StateNames(),
      .parameters = {{"pipe_length", "m", 20, 40, 30, "of each heat exchanger; it decides the mass of refrigerant"}},
      .options = {NominalOption(),
                  {.name = "hold_s", .unit = "s", .default_value = "5",
                   .description = "how long a drawn frequency (40 to 80 Hz) and valve position (282 to 312 counts) are held",
                   .min = kVaporCompressionSamplePeriodS},
                  {.name = "settle_s", .unit = "s", .default_value = "50",
                   .description = "time at 50 Hz and 300 counts before the first sample", .min = 0},
                  {.name = "pressure_noise_std", .unit = "Pa", .default_value = "0",
                   .description = "standard deviation of white noise on measured pressures", .min = 0},
                  {.name = "temperature_noise_std", .unit = "K", .default_value = "0",
                   .description = "standard deviation of white noise on measured temperatures", .min = 0}},
      .simulate = SimulateRun};
  return system;
}

}  // namespace metaekf::sim
