#include "core/filter/smoother.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/LU>

#include "tests/core/filter/linear_filter.h"
#include "tests/core/nssm/random_models.h"
#include "tests/support/bundles.h"

namespace metaekf::filter {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

struct Recorded {
  data::Trajectory trajectory;
  MatrixXd truth;
};

Recorded Record(uint64_t seed, Index steps, double missing) {
  LinearTruth truth(LinearSystem(), seed);
  Recorded recorded{{.inputs = MatrixXd(1, steps), .outputs = MatrixXd(2, steps)}, MatrixXd(2, steps)};
  for (Index t = 0; t < steps; ++t) {
    recorded.truth.col(t) = truth.state;
    recorded.trajectory.outputs.col(t) = truth.Measure();
    for (Index i = 0; i < 2; ++i) {
      if (truth.rng.Uniform() < missing) recorded.trajectory.outputs(i, t) = kNaN;
    }
    recorded.trajectory.inputs(0, t) = truth.rng.Normal();
    truth.Advance(recorded.trajectory.inputs(0, t));
  }
  return recorded;
}

// Oracle: all states of a short recording at once, as one Gaussian conditioned on one linear measurement.
TEST(SmootherTest, EqualsTheJointPosteriorOfALinearSystem) {
  const LinearSystem s;
  constexpr Index kSteps = 12;
  const Recorded recorded = Record(3, kSteps, 0.2);
  VectorXd mean = VectorXd::Zero(2 * kSteps);
  MatrixXd cov = MatrixXd::Zero(2 * kSteps, 2 * kSteps);
  cov.topLeftCorner(2, 2) = s.P0;
  for (Index t = 1; t < kSteps; ++t) {
    mean.segment(2 * t, 2) = s.A * mean.segment(2 * t - 2, 2) + s.B * recorded.trajectory.inputs(0, t - 1);
    cov.block(2 * t, 0, 2, 2 * t) = s.A * cov.block(2 * t - 2, 0, 2, 2 * t);
    cov.block(0, 2 * t, 2 * t, 2) = cov.block(2 * t, 0, 2, 2 * t).transpose();
    cov.block(2 * t, 2 * t, 2, 2) = s.A * cov.block(2 * t - 2, 2 * t - 2, 2, 2) * s.A.transpose() + s.Q;
  }
  MatrixXd H = MatrixXd::Zero(2 * kSteps, 2 * kSteps), R = H;
  std::vector<Index> rows;
  for (Index t = 0; t < kSteps; ++t) {
    H.block(2 * t, 2 * t, 2, 2) = s.C;
    R.block(2 * t, 2 * t, 2, 2) = s.R;
    for (Index i = 0; i < 2; ++i) {
      if (!std::isnan(recorded.trajectory.outputs(i, t))) rows.push_back(2 * t + i);
    }
  }
  const MatrixXd Hm = H(rows, Eigen::all), S = Hm * cov * Hm.transpose() + R(rows, rows), K = cov * Hm.transpose() * S.inverse();
  mean += K * (recorded.trajectory.outputs.reshaped()(rows) - Hm * mean);
  cov -= K * Hm * cov;

  const nssm::Bundle bundle = LinearBundle(s);
  const Filter filter(bundle);
  const auto smoothed = Smooth(filter.ekf, recorded.trajectory, filter.scratch.get());
  ASSERT_TRUE(smoothed.ok()) << smoothed.status();
  for (Index t = 0; t < kSteps; ++t) {
    EXPECT_LT(((*smoothed)[static_cast<size_t>(t)].mean - mean.segment(2 * t, 2)).norm(), 1e-10) << t;
    EXPECT_LT(((*smoothed)[static_cast<size_t>(t)].cov - cov.block(2 * t, 2 * t, 2, 2)).norm(), 1e-10) << t;
  }
}

TEST(SmootherTest, IsSurerAndCloserThanTheFilter) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  Filter filter(bundle);
  const Recorded recorded = Record(5, 2000, 0);
  const auto smoothed = *Smooth(filter.ekf, recorded.trajectory, filter.scratch.get());
  double filter_squares = 0, smoother_squares = 0, nees = 0;
  for (Index t = 0; t < 2000; ++t) {
    ASSERT_TRUE(filter.ekf.Step(recorded.trajectory.inputs.col(t), recorded.trajectory.outputs.col(t), filter.scratch.get(), &filter.estimate).ok());
    const Estimate& smooth = smoothed[static_cast<size_t>(t)];
    EXPECT_LE(smooth.cov.trace(), filter.estimate.cov.trace() * (1 + 1e-12));
    filter_squares += (filter.estimate.mean - recorded.truth.col(t)).squaredNorm();
    const VectorXd error = smooth.mean - recorded.truth.col(t);
    smoother_squares += error.squaredNorm();
    nees += error.dot(smooth.cov.inverse() * error);
    EXPECT_EQ(smooth.nis, filter.estimate.nis);
  }
  EXPECT_LT(smoother_squares, 0.8 * filter_squares);
  EXPECT_NEAR(nees / 2000, 2, 0.3);
}

TEST(SmootherTest, NothingPassesAFreshStart) {
  // The system jumps: the filter is widened there, and what comes later hardly moves what was before.
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  const Filter filter(bundle);
  Recorded recorded = Record(6, 200, 0);
  recorded.trajectory.outputs.rightCols(100).array() += 1000;
  const auto smoothed = *Smooth(filter.ekf, recorded.trajectory, filter.scratch.get());
  data::Trajectory before = recorded.trajectory;
  before.inputs.conservativeResize(1, 100);
  before.outputs.conservativeResize(2, 100);
  const auto head = *Smooth(filter.ekf, before, filter.scratch.get());
  EXPECT_LT((smoothed[90].mean - head[90].mean).norm(), 1);
  EXPECT_TRUE(smoothed[105].reset);
}

TEST(SmootherTest, EveryKindOfModelIsSmoothed) {
  for (const nssm::ModelCase& c : nssm::ModelCases()) {
    SCOPED_TRACE(c.name);
    nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(c.model));
    bundle.parameters = nssm::RandomParameters(bundle.model, 3);
    if (c.model.fits_start()) continue;  // has no prior here
    Filter filter(bundle);
    data::Trajectory trajectory = nssm::RandomTrajectory(c.model, 60, 2);
    const auto smoothed = Smooth(filter.ekf, trajectory, filter.scratch.get());
    ASSERT_TRUE(smoothed.ok()) << smoothed.status();
    for (Index t = 0; t < 60; ++t) {
      const Estimate& estimate = (*smoothed)[static_cast<size_t>(t)];
      const bool known = t >= c.model.warmup() - 1;
      EXPECT_EQ(estimate.mean.allFinite(), known) << t;
      if (!known) continue;
      Eigen::LLT<MatrixXd> cholesky(estimate.cov + 1e-9 * MatrixXd::Identity(estimate.cov.rows(), estimate.cov.rows()));
      EXPECT_EQ(cholesky.info(), Eigen::Success);
      if (bundle.model.state_set() != nullptr) {
        EXPECT_TRUE(physics::Contains(*bundle.model.state_set(), estimate.mean));
      }
    }
  }
}

TEST(SmootherTest, AWrongSampleIsNamed) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  const Filter filter(bundle);
  Recorded recorded = Record(5, 10, 0);
  recorded.trajectory.inputs(0, 6) = kNaN;
  EXPECT_THAT(std::string(Smooth(filter.ekf, recorded.trajectory, filter.scratch.get()).status().message()),
              testing::HasSubstr("sample 7"));
}

}  // namespace
}  // namespace metaekf::filter
