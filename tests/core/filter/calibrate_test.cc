#include "core/filter/calibrate.h"

#include <gtest/gtest.h>

#include "tests/core/filter/linear_filter.h"

namespace metaekf::filter {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double kNoPrior = std::numeric_limits<double>::infinity();

std::vector<CalibrationRun> Runs(const nssm::Bundle& bundle, int count, Index steps, uint64_t first_seed = 100, const LinearSystem& system = {}) {
  std::vector<CalibrationRun> runs;
  for (int run = 0; run < count; ++run) {
    LinearTruth truth(system, first_seed + static_cast<uint64_t>(run));
    data::Trajectory trajectory{.inputs = MatrixXd(1, steps), .outputs = MatrixXd(2, steps), .states = MatrixXd(2, steps)};
    for (Index t = 0; t < steps; ++t) {
      trajectory.states.col(t) = truth.state;
      trajectory.outputs.col(t) = truth.Measure();
      trajectory.inputs(0, t) = truth.rng.Normal();
      truth.Advance(trajectory.inputs(0, t));
    }
    runs.push_back(RunOf(bundle, std::move(trajectory)));
  }
  return runs;
}

TEST(CalibrateTest, FindsTheNoiseOfAKnownSystemFromWrongScales) {
  nssm::Bundle bundle = LinearBundle(LinearSystem());
  const nssm::FilterNoise truth = bundle.noise;
  const Eigen::Vector2d wrong_q(0.1, 3), wrong_r(2, 0.2);  // factors of deviations
  bundle.noise.process = wrong_q.asDiagonal() * truth.process * wrong_q.asDiagonal();
  bundle.noise.measurement = wrong_r.asDiagonal() * truth.measurement * wrong_r.asDiagonal();
  const auto executor = base::MakeThreadExecutor(2);
  const nssm::FilterNoise found = Calibrate(bundle, Runs(bundle, 10, 400), kNoPrior, executor.get());
  // 4,000 samples determine variances to a few per cent; the search ends at steps of a tenth in the logarithm.
  for (Index i = 0; i < 2; ++i) {
    EXPECT_NEAR(std::log(found.process(i, i) / truth.process(i, i)), 0, 0.25) << i;
    EXPECT_NEAR(std::log(found.measurement(i, i) / truth.measurement(i, i)), 0, 0.25) << i;
  }
  EXPECT_EQ(found.initial, truth.initial);
  // Correlations are not touched.
  EXPECT_NEAR(found.process(0, 1) / std::sqrt(found.process(0, 0) * found.process(1, 1)),
              truth.process(0, 1) / std::sqrt(truth.process(0, 0) * truth.process(1, 1)), 1e-12);
}

double ShareHeld(nssm::Bundle bundle, const nssm::FilterNoise& noise, const std::vector<CalibrationRun>& runs) {
  bundle.noise = noise;
  int held = 0, all = 0;
  for (const CalibrationRun& run : runs) {
    Filter filter(bundle);
    for (Index t = 0; t < run.trajectory.length(); ++t) {
      EXPECT_TRUE(filter.ekf.Step(run.trajectory.inputs.col(t), run.trajectory.outputs.col(t), filter.scratch.get(), &filter.estimate).ok());
      for (Index i = 0; i < 2; ++i, ++all) {
        held += std::abs(filter.estimate.mean[i] - run.trajectory.states(i, t)) <= 1.96 * std::sqrt(filter.estimate.cov(i, i)) ? 1 : 0;
      }
    }
  }
  return static_cast<double>(held) / all;
}

// Every fifth system errs far more than the others. What explains the innovations best calls its errors outliers; bounds must count them.
TEST(CalibrateTest, BoundsOfAFleetHoldItsOddSystemsToo) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  LinearSystem odd;
  odd.Q *= 60;
  const auto fleet = [&](uint64_t seed) {
    std::vector<CalibrationRun> runs = Runs(bundle, 32, 200, seed), others = Runs(bundle, 8, 200, seed + 500, odd);
    for (size_t i = 0; i < others.size(); ++i) runs.insert(runs.begin() + static_cast<ptrdiff_t>(5 * i + i % 2), others[i]);
    return runs;
  };
  const auto executor = base::MakeThreadExecutor(2);
  const nssm::FilterNoise found = Calibrate(bundle, fleet(1000), kNoPrior, executor.get());
  EXPECT_NEAR(ShareHeld(bundle, found, fleet(3000)), 0.95, 0.01);
}

TEST(CalibrateTest, WidensBoundsWhereNewSystemsAreFollowedWorseThanThoseTrainedOn) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  const auto executor = base::MakeThreadExecutor(2);
  LinearSystem worse;
  worse.Q *= 9;
  const auto calibrate = [&](const LinearSystem& of_new, bool told) {
    std::vector<CalibrationRun> runs = Runs(bundle, 8, 200, 1000, of_new), known = Runs(bundle, 24, 200, 2000);
    for (CalibrationRun& run : known) run.trained_on = told;
    runs.insert(runs.end(), known.begin(), known.end());
    return Calibrate(bundle, runs, kNoPrior, executor.get());
  };
  // Where they are followed as well, what chance makes of it is not taken for more.
  const double same = calibrate({}, true).process(0, 0) / calibrate({}, false).process(0, 0);
  EXPECT_NEAR(same, 1, 0.1);
  const std::vector<CalibrationRun> fresh = Runs(bundle, 20, 200, 5000, worse);
  EXPECT_GT(ShareHeld(bundle, calibrate(worse, true), fresh), ShareHeld(bundle, calibrate(worse, false), fresh) + 0.02);
}

// Eight systems that happen to be easy say what noise is like; many more say how wide bounds must be, and nothing else.
TEST(CalibrateTest, SystemsThatSayOnlyHowWideBoundsMustBeWidenAllAlike) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  LinearSystem usual;
  usual.Q *= 9;
  usual.R *= 3;
  std::vector<CalibrationRun> runs = Runs(bundle, 8, 200, 1000), rest = Runs(bundle, 60, 200, 2000, usual);
  for (CalibrationRun& run : rest) run.width_only = true;
  const auto executor = base::MakeThreadExecutor(2);
  const nssm::FilterNoise of_few = Calibrate(bundle, runs, kNoPrior, executor.get());
  runs.insert(runs.end(), rest.begin(), rest.end());
  const nssm::FilterNoise found = Calibrate(bundle, runs, kNoPrior, executor.get());
  EXPECT_GT(found.process(0, 0), 2 * of_few.process(0, 0));
  EXPECT_NEAR(found.process(0, 0) / of_few.process(0, 0), found.measurement(1, 1) / of_few.measurement(1, 1), 1e-6);
  std::vector<CalibrationRun> fresh = Runs(bundle, 6, 200, 4000), others = Runs(bundle, 45, 200, 5000, usual);
  fresh.insert(fresh.end(), others.begin(), others.end());
  EXPECT_NEAR(ShareHeld(bundle, found, fresh), 0.95, 0.02);
}

// A model with a wrong A: its one-step residuals are small, but they last. What is calibrated holds the truth, what the residuals say
// does not.
TEST(CalibrateTest, CountsThatErrorsOfAModelLast) {
  LinearSystem wrong;
  wrong.A(0, 0) = 0.97;
  nssm::Bundle bundle = LinearBundle(wrong);
  const std::vector<CalibrationRun> runs = Runs(bundle, 20, 300);
  const std::vector<CalibrationRun> seen(runs.begin(), runs.begin() + 10), unseen(runs.begin() + 10, runs.end());
  nssm::FilterNoise residual = LinearBundle(LinearSystem()).noise;
  bundle.noise = residual;
  const nssm::FilterNoise calibrated = Calibrate(bundle, seen, kNoPrior, base::CallingThread());
  EXPECT_LT(ShareHeld(bundle, residual, unseen), 0.93);
  EXPECT_NEAR(ShareHeld(bundle, calibrated, unseen), 0.95, 0.02);
}

// Of a system that errs in ways that last, from wrong ideas of how much and how long: bounds hold what they say, and innovations are as
// large as they say, which no Q and R alone can have together.
TEST(CalibrateTest, FindsErrorsThatLast) {
  const ErringSystem c;
  nssm::Bundle bundle = c.Known();
  bundle.noise.process_bias.loadings *= 0.4;
  bundle.noise.measurement_bias.loadings *= 2;
  bundle.noise.measurement_bias.correlation = 0.6;
  bundle.noise.measurement *= 2;
  std::vector<CalibrationRun> runs;
  for (uint64_t seed = 1; seed <= 10; ++seed) runs.push_back(RunOf(bundle, c.Record(seed, 400)));
  const auto executor = base::MakeThreadExecutor(2);
  const auto judge = [&](const nssm::FilterNoise& noise) {
    bundle.noise = noise;
    double held = 0, nis = 0, all = 0;
    for (uint64_t seed = 101; seed <= 110; ++seed) {
      Filter filter(bundle);
      const data::Trajectory run = c.Record(seed, 400);
      for (Index t = 0; t < run.length(); ++t, all += 2) {
        EXPECT_TRUE(filter.ekf.Step(run.inputs.col(t), run.outputs.col(t), filter.scratch.get(), &filter.estimate).ok());
        for (Index i = 0; i < 2; ++i) held += std::abs(filter.estimate.mean[i] - run.states(i, t)) <= 1.96 * std::sqrt(filter.estimate.cov(i, i)) ? 1 : 0;
        nis += filter.estimate.nis;
      }
    }
    return std::pair{held / all, nis / all};
  };
  const nssm::FilterNoise found = Calibrate(bundle, runs, kNoPrior, executor.get());
  bundle.noise.process_bias = bundle.noise.measurement_bias = {};
  const nssm::FilterNoise white = Calibrate(bundle, runs, kNoPrior, executor.get());
  const auto [held, nis] = judge(found);
  EXPECT_NEAR(held, 0.95, 0.02);
  EXPECT_NEAR(nis, 1, 0.1);
  const auto [white_held, white_nis] = judge(white);
  EXPECT_GT(std::abs(white_held - 0.95) + std::abs(white_nis - 1), std::abs(held - 0.95) + std::abs(nis - 1) + 0.05);
}

TEST(CalibrateTest, AStrongPriorKeepsWhatIsThere) {
  nssm::Bundle bundle = LinearBundle(LinearSystem());
  bundle.noise.process *= 5;
  const nssm::FilterNoise kept = Calibrate(bundle, Runs(bundle, 1, 100), 1e-3, base::CallingThread());
  EXPECT_NEAR(kept.process(0, 0) / bundle.noise.process(0, 0), 1, 0.01);
  EXPECT_EQ(Calibrate(bundle, Runs(bundle, 1, 100), 0, base::CallingThread()).process, bundle.noise.process);
}

TEST(CalibrateTest, WhatItFindsExplainsRecordingsBetter) {
  nssm::Bundle bundle = LinearBundle(LinearSystem());
  const std::vector<CalibrationRun> runs = Runs(bundle, 3, 300);
  const double of_truth = Explain(bundle, runs, base::CallingThread()).likelihood;
  bundle.noise.process *= 20;
  const double of_guess = Explain(bundle, runs, base::CallingThread()).likelihood;
  bundle.noise = Calibrate(bundle, runs, kNoPrior, base::CallingThread());
  const double of_found = Explain(bundle, runs, base::CallingThread()).likelihood;
  EXPECT_GT(of_truth, of_guess + 0.1);
  EXPECT_GT(of_found, of_truth - 0.01);
}

TEST(CalibrateTest, WidenedNoiseHoldsWhatItShould) {
  nssm::Bundle bundle = LinearBundle(LinearSystem());
  const std::vector<CalibrationRun> runs = Runs(bundle, 10, 500);
  EXPECT_NEAR(LogWidening(Explain(bundle, runs, base::CallingThread()).ratios), 0, 0.1);
  bundle.noise = Widened(bundle.noise, std::log(0.5));  // all of it: a gain depends on ratios alone, so errors are the same
  EXPECT_NEAR(LogWidening(Explain(bundle, runs, base::CallingThread()).ratios), std::log(2), 0.1);
  EXPECT_EQ(LogWidening({}), 0);
}

// Longer than what a search looks at.
TEST(CalibrateTest, WhatComesLateInARecordingCounts) {
  constexpr Index kSteps = 4000;
  nssm::Bundle bundle = LinearBundle(LinearSystem());
  std::vector<CalibrationRun> runs = Runs(bundle, 1, kSteps);
  base::Rng rng(5);
  const double noise_std = std::sqrt(8 * bundle.noise.measurement(0, 0));
  for (Index t = kSteps / 2; t < kSteps; ++t) runs[0].trajectory.outputs(0, t) += noise_std * rng.Normal();
  const nssm::FilterNoise found = Calibrate(bundle, runs, kNoPrior, base::CallingThread());
  EXPECT_NEAR(found.measurement(0, 0) / bundle.noise.measurement(0, 0), 5, 1.5);
  EXPECT_NEAR(found.measurement(1, 1) / bundle.noise.measurement(1, 1), 1, 0.2);
}

TEST(CalibrateTest, AModelThatDivergesKeepsItsNoise) {
  LinearSystem explosive;
  explosive.A *= 1e9;
  explosive.C.setZero();
  const nssm::Bundle bundle = LinearBundle(explosive);
  const nssm::FilterNoise kept = Calibrate(bundle, Runs(bundle, 1, 200), kNoPrior, base::CallingThread());
  EXPECT_EQ(kept.process, bundle.noise.process);
}

}  // namespace
}  // namespace metaekf::filter
