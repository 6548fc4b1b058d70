#include "core/sim/bouc_wen.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <numbers>

#include "core/data/csv.h"
#include "core/sim/simulate.h"

namespace metaekf::sim {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

constexpr BoucWenParameters kNominal = {2, 10, 5e4, 5e4, 1000, 0.8, -1.1};
const Eigen::Vector3d kRest = Eigen::Vector3d::Zero();

absl::StatusOr<Fleet> SimulateWith(Request request) {
  request.system = "bouc-wen";
  base::Executor* const executor = base::CallingThread();
  return Simulate(request, *executor);
}

std::string ErrorOf(const Request& request) {
  const auto fleet = SimulateWith(request);
  EXPECT_EQ(fleet.status().code(), absl::StatusCode::kInvalidArgument);
  return std::string(fleet.status().message());
}

std::vector<double> Multisine(uint64_t seed, Eigen::Index period) {
  base::Rng rng(seed);
  return *DrawMultisine(5.0 / 750, 150.0 / 750, 50, period, rng);
}

TEST(BoucWenTest, WithoutHysteresisIsADampedOscillator) {
  // α = β = 0 leaves m ẍ + c ẋ + k x = 0: x = x₀ e^(−ct/2m) (cos ωt + c/(2mω) sin ωt), ω² = k/m −
  // (c/2m)².
  const BoucWenParameters linear = {2, 10, 5e4, 0, 0, 0.8, -1.1};
  const Signal silence = Signal::FromRecord({0}, Hold::kZero, kBoucWenSegmentsPerSample);
  const Eigen::MatrixXd states =
      SimulateBoucWen(linear, silence, Eigen::Vector3d(1e-3, 0, 0), 0, 400);
  const double decay = 10 / 4.0;
  const double omega = std::sqrt(5e4 / 2 - decay * decay);
  for (Eigen::Index t = 0; t < 400; ++t) {
    const double time_s = static_cast<double>(t) / 750;
    const double expected = 1e-3 * std::exp(-decay * time_s) *
                            (std::cos(omega * time_s) + decay / omega * std::sin(omega * time_s));
    EXPECT_NEAR(states(0, t), expected, 1e-10);
  }
}

/// The equations written once more, stepped by Heun's method with a sine evaluated directly: slow,
/// plain, and of order 2 across kinks too.
Eigen::MatrixXd ByHeun(const BoucWenParameters& p, Eigen::Index samples, int steps_per_sample) {
  const auto derivative = [&p](double time_s, const Eigen::Vector3d& x) {
    const double u = 120 * std::sin(2 * std::numbers::pi * 20 * time_s);
    Eigen::Vector3d dx;
    dx[0] = x[1];
    dx[1] = (u - p.k_L * x[0] - p.c_L * x[1] - x[2]) / p.m_L;
    dx[2] = p.alpha * x[1] -
            p.beta * (p.gamma * std::fabs(x[1]) * x[2] + p.delta * x[1] * std::fabs(x[2]));
    return dx;
  };
  const double h = 1.0 / 750 / steps_per_sample;
  Eigen::MatrixXd states(3, samples);
  Eigen::Vector3d x = kRest;
  for (Eigen::Index t = 0; t < samples; ++t) {
    states.col(t) = x;
    for (int i = 0; i < steps_per_sample; ++i) {
      const double time_s = static_cast<double>(t) / 750 + i * h;
      const Eigen::Vector3d slope = derivative(time_s, x);
      const Eigen::Vector3d end_slope = derivative(time_s + h, x + h * slope);
      x += h / 2 * (slope + end_slope);
    }
  }
  return states;
}

TEST(BoucWenTest, AgreesWithAPlainIntegrationOfTheEquations) {
  const Signal sine = Signal::Sine(120, 20.0 / 750, 0, 201, kBoucWenSegmentsPerSample);
  const Eigen::MatrixXd states = SimulateBoucWen(kNominal, sine, kRest, 0, 200);
  // Heun's errors are h² times a constant: 4000 steps per sample and the extrapolation from 2000
  // leave below 1e-11 m.
  const Eigen::MatrixXd plain = ByHeun(kNominal, 200, 4000);
  const Eigen::MatrixXd coarser = ByHeun(kNominal, 200, 2000);
  const Eigen::MatrixXd expected = plain + (plain - coarser) / 3;
  EXPECT_LT((states - expected).row(0).cwiseAbs().maxCoeff(), 1e-10);
  EXPECT_LT((states - expected).row(1).cwiseAbs().maxCoeff(), 1e-7);
  EXPECT_LT((states - expected).row(2).cwiseAbs().maxCoeff(), 1e-5);
  // The loops must be there for that to mean anything: forces of the order of the sine's.
  EXPECT_GT(states.row(2).cwiseAbs().maxCoeff(), 30);
}

TEST(BoucWenTest, HalvingTheStepChangesTheOutputByLessThanANanometre) {
  const std::vector<double> record = Multisine(4, 2048);
  const Signal coarse = Signal::FromRecord(record, Hold::kBandLimited, kBoucWenSegmentsPerSample);
  const Signal fine = Signal::FromRecord(record, Hold::kBandLimited, 2 * kBoucWenSegmentsPerSample);
  // Nominal; the corner with the stiffest loops; and random points of the box.
  std::vector<BoucWenParameters> points = {kNominal, {1, 5, 2.5e4, 7.5e4, 4500, 0.5, -1.5}};
  base::Rng rng(8);
  for (int i = 0; i < 6; ++i) {
    points.push_back({rng.Uniform(1, 3), rng.Uniform(5, 15), rng.Uniform(2.5e4, 7.5e4),
                      rng.Uniform(2.5e4, 7.5e4), rng.Uniform(500, 4500), rng.Uniform(0.5, 0.9),
                      rng.Uniform(-1.5, -0.5)});
  }
  for (const BoucWenParameters& p : points) {
    const Eigen::MatrixXd states = SimulateBoucWen(p, coarse, kRest, 0, 2048);
    // Half the step, and the tolerance that half a step meets where it is smooth: 2⁻⁵ of it.
    const Eigen::MatrixXd halved =
        SimulateBoucWen(p, fine, kRest, 0, 2048, kBoucWenToleranceM / 32);
    EXPECT_LT((states - halved).row(0).cwiseAbs().maxCoeff(), 1e-9) << p.beta << " " << p.delta;
  }
}

TEST(BoucWenTest, RepeatsItselfInTheSteadyStateAfterTheWarmUp) {
  const auto fleet =
      SimulateWith({.steps = 16384, .settings = {{"nominal", "1"}, {"states", "1"}}});
  ASSERT_TRUE(fleet.ok()) << fleet.status();
  const data::Trajectory& trajectory = fleet->dataset.trajectories[0];
  EXPECT_EQ(trajectory.inputs.leftCols(8192), trajectory.inputs.rightCols(8192));
  const Eigen::MatrixXd drift =
      trajectory.outputs.leftCols(8192) - trajectory.outputs.rightCols(8192);
  EXPECT_LT(drift.cwiseAbs().maxCoeff(), 1e-8);
  // From rest the first period is still far from it.
  const auto cold = SimulateWith({.settings = {{"nominal", "1"}, {"warmup_periods", "0"}}});
  ASSERT_TRUE(cold.ok());
  EXPECT_EQ(cold->dataset.trajectories[0].outputs(0, 0), 0);
  const Eigen::MatrixXd transient =
      cold->dataset.trajectories[0].outputs - trajectory.outputs.leftCols(8192);
  EXPECT_GT(transient.cwiseAbs().maxCoeff(), 1e-4);
}

TEST(BoucWenTest, HidesItsStatesUnlessTold) {
  const auto hidden = SimulateWith({.steps = 50});
  ASSERT_TRUE(hidden.ok());
  EXPECT_THAT(hidden->dataset.input_names, ElementsAre("u1"));
  EXPECT_THAT(hidden->dataset.output_names, ElementsAre("y1"));
  EXPECT_TRUE(hidden->dataset.state_names.empty());
  const auto shown = SimulateWith({.steps = 50, .settings = {{"states", "1"}}});
  ASSERT_TRUE(shown.ok());
  EXPECT_THAT(shown->dataset.state_names, ElementsAre("x1", "x2", "x3"));
  EXPECT_EQ(shown->dataset.trajectories[0].states.row(0), shown->dataset.trajectories[0].outputs);
  EXPECT_EQ(shown->dataset.trajectories[0].outputs, hidden->dataset.trajectories[0].outputs);
}

TEST(BoucWenTest, TheSineIsThePapersExcitation) {
  const auto fleet = SimulateWith({.settings = {{"excitation", "sine"}}});
  ASSERT_TRUE(fleet.ok());
  const data::Trajectory& trajectory = fleet->dataset.trajectories[0];
  EXPECT_EQ(trajectory.length(), 10000);
  EXPECT_EQ(trajectory.sample_period_s, 1.0 / 750);
  for (const Eigen::Index t : {0, 100, 9999}) {
    EXPECT_NEAR(trajectory.inputs(0, t),
                120 * std::sin(2 * std::numbers::pi * static_cast<double>(t) / 750), 1e-9);
  }
}

TEST(BoucWenTest, StartsWhereItIsTold) {
  const auto fleet = SimulateWith(
      {.steps = 5,
       .settings = {{"x1_0", "1e-3"}, {"x2_0", "0.2"}, {"x3_0", "-7"}, {"states", "1"}}});
  ASSERT_TRUE(fleet.ok());
  EXPECT_EQ(fleet->dataset.trajectories[0].states.col(0), Eigen::Vector3d(1e-3, 0.2, -7));
}

TEST(BoucWenTest, ARecordedMultisineGivesTheSameAsTheMultisine) {
  const auto drawn = SimulateWith({.settings = {{"nominal", "1"}, {"period", "1024"}}});
  ASSERT_TRUE(drawn.ok());
  const data::Trajectory& trajectory = drawn->dataset.trajectories[0];
  const auto replayed =
      SimulateWith({.settings = {{"nominal", "1"}},
                    .input = RecordedInput{trajectory.inputs, 1.0 / 750, Hold::kBandLimited}});
  ASSERT_TRUE(replayed.ok()) << replayed.status();
  EXPECT_EQ(replayed->dataset.trajectories[0].inputs, trajectory.inputs);
  EXPECT_EQ(replayed->dataset.trajectories[0].outputs, trajectory.outputs);
}

TEST(BoucWenTest, RefusesWhatMakesNoSense) {
  EXPECT_THAT(ErrorOf({.settings = {{"m_L", "0"}}}), HasSubstr("a mass must be positive"));
  EXPECT_THAT(ErrorOf({.settings = {{"band_min", "200"}}}), HasSubstr("band"));
  EXPECT_THAT(ErrorOf({.settings = {{"amplitude", "3"}}}),
              HasSubstr("amplitude has no effect on a multisine"));
  EXPECT_THAT(ErrorOf({.settings = {{"rms", "3"}, {"excitation", "sine"}}}),
              HasSubstr("rms has no effect on a sine"));
  EXPECT_THAT(
      ErrorOf({.settings = {{"rms", "3"}}, .input = RecordedInput{Eigen::MatrixXd::Zero(1, 9)}}),
      HasSubstr("rms has no effect on a recorded input"));
  EXPECT_THAT(ErrorOf({.settings = {{"k_L", "-1e6"}, {"alpha", "0"}, {"beta", "0"}}}),
              HasSubstr("diverges"));
}

// -------- against the measured benchmark

/// The folder with the measured data, or nothing.
std::optional<std::filesystem::path> SharedData() {
  const char* const set = std::getenv("METAEKF_SHARED_DATA");
  const std::filesystem::path folder =
      set != nullptr ? std::filesystem::path(set)
                     : std::filesystem::path(METAEKF_SOURCE_DIR) / ".." / "shared" / "data";
  if (!std::filesystem::exists(folder / "boucwen" / "estimation.csv")) return std::nullopt;
  return folder;
}

/// RMSE of the nominal system's steady response to the measured input, held as `hold` says, against
/// the mean of the five measured periods.
double RmseAgainstMeasurement(const data::Trajectory& measured, Hold hold) {
  Eigen::MatrixXd input = Eigen::MatrixXd::Zero(1, 8192), output = input;
  for (int period = 0; period < 5; ++period) {
    input += measured.inputs.middleCols(period * 8192, 8192) / 5;
    output += measured.outputs.middleCols(period * 8192, 8192) / 5;
  }
  const auto fleet =
      SimulateWith({.settings = {{"nominal", "1"}}, .input = RecordedInput{input, 0, hold}});
  EXPECT_TRUE(fleet.ok()) << fleet.status();
  return std::sqrt((fleet->dataset.trajectories[0].outputs - output).squaredNorm() / 8192);
}

TEST(BoucWenTest, TheNominalSystemIsTheMeasuredOneToWithinItsNoise) {
  const auto folder = SharedData();
  if (!folder) GTEST_SKIP() << "no measured data; METAEKF_SHARED_DATA names their folder";
  const auto dataset = data::ReadCsvFile((*folder / "boucwen" / "estimation.csv").string());
  ASSERT_TRUE(dataset.ok()) << dataset.status();
  const data::Trajectory& measured = dataset->trajectories[0];
  ASSERT_EQ(measured.length(), 40960);
  // From the notes that come with the data: 3.3e-6 (their noise, 7.5e-6 / √5), 7.9e-6 and 1.0e-4 m.
  EXPECT_LT(RmseAgainstMeasurement(measured, Hold::kBandLimited), 3.6e-6);
  EXPECT_NEAR(RmseAgainstMeasurement(measured, Hold::kLinear), 7.9e-6, 0.2e-6);
  EXPECT_NEAR(RmseAgainstMeasurement(measured, Hold::kZero), 1.0e-4, 0.1e-4);
}

}  // namespace
}  // namespace metaekf::sim
