#include "core/filter/draw.h"

#include <gtest/gtest.h>

#include "tests/core/filter/linear_filter.h"

namespace metaekf::filter {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr Index kHorizon = 20;
constexpr int kDraws = 4000;

// Everything in the model is linear: what is drawn has the mean and the covariance that the forecast says, and a filter that goes on from where
// the draws did is right about them.
TEST(DrawTest, DrawsHaveTheForecastsMomentsAndTheirFilterIsConsistent) {
  nssm::Bundle bundle = ErringSystem().Known();
  bundle.normaliser.states = {Eigen::Vector2d(3, -1), Eigen::Vector2d(2, 0.5)};
  bundle.normaliser.outputs = {Eigen::Vector2d(1, 2), Eigen::Vector2d(0.5, 4)};
  bundle.normaliser.inputs = {VectorXd::Constant(1, 0.3), VectorXd::Constant(1, 2)};
  Filter filter(bundle);
  base::Rng rng(3);
  for (int t = 0; t < 5; ++t) {
    ASSERT_TRUE(filter.ekf.Step(RandomVector(&rng, 1), RandomVector(&rng, 2), filter.scratch.get(), &filter.estimate).ok());
  }
  const Estimate present = filter.estimate;
  const MatrixXd inputs = MatrixXd::Random(1, kHorizon);
  const std::vector<Estimate> forecast = *filter.ekf.Forecast(inputs, filter.scratch.get());
  MatrixXd mean = MatrixXd::Zero(2, kHorizon);
  std::vector<MatrixXd> squares(kHorizon, MatrixXd::Zero(2, 2));
  double nees_now = 0, nees = 0, nis = 0;
  for (int draw = 0; draw < kDraws; ++draw) {
    const Future future = *Draw(filter.ekf, inputs, &rng, filter.scratch.get());
    Ekf follower = filter.ekf;
    for (Index t = 0; t < kHorizon; ++t) {
      const VectorXd error = future.truth.col(t) - forecast[static_cast<size_t>(t)].mean;
      mean.col(t) += error / kDraws;
      squares[static_cast<size_t>(t)] += error * error.transpose() / kDraws;
      ASSERT_TRUE(follower.Step(inputs.col(t), future.outputs.col(t), filter.scratch.get(), &filter.estimate).ok());
      nis += filter.estimate.nis;
    }
    const VectorXd error = future.truth.col(kHorizon - 1) - filter.estimate.mean;
    const VectorXd now = future.now - present.mean;
    nees_now += now.dot(present.cov.llt().solve(now));
    nees += error.dot(filter.estimate.cov.llt().solve(error));
  }
  for (const Index t : {Index{0}, kHorizon - 1}) {
    const MatrixXd& cov = forecast[static_cast<size_t>(t)].cov;
    for (Index i = 0; i < 2; ++i) {
      EXPECT_LT(std::abs(mean(i, t)), 4 * std::sqrt(cov(i, i) / kDraws)) << t;
      for (Index j = 0; j < 2; ++j) EXPECT_NEAR(squares[static_cast<size_t>(t)](i, j), cov(i, j), 0.1 * std::sqrt(cov(i, i) * cov(j, j))) << t;
    }
  }
  // χ² of 2 kDraws degrees of freedom; innovations are independent of each other.
  EXPECT_NEAR(nees_now / kDraws, 2, 4 * 2 / std::sqrt(kDraws));
  EXPECT_NEAR(nees / kDraws, 2, 4 * 2 / std::sqrt(kDraws));
  EXPECT_NEAR(nis / (kDraws * kHorizon), 2, 4 * 2 / std::sqrt(kDraws * kHorizon));
}

TEST(DrawTest, TheSameNumbersDrawTheSame) {
  Filter filter(LinearBundle(LinearSystem()));
  ASSERT_TRUE(filter.ekf.Step(VectorXd::Zero(1), VectorXd::Zero(2), filter.scratch.get(), &filter.estimate).ok());
  base::Rng one(1), same(1), other(2);
  const auto outputs = [&](base::Rng* rng) { return Draw(filter.ekf, MatrixXd::Zero(1, 3), rng, filter.scratch.get())->outputs; };
  const MatrixXd first = outputs(&one);
  EXPECT_EQ(first, outputs(&same));
  EXPECT_NE(first, outputs(&other));
}

TEST(DrawTest, AFilterWithoutAnEstimateIsRefused) {
  Filter filter(LinearBundle(LinearSystem()));
  base::Rng rng(1);
  EXPECT_EQ(Draw(filter.ekf, MatrixXd::Zero(1, 3), &rng, filter.scratch.get()).status().code(), absl::StatusCode::kFailedPrecondition);
}

}  // namespace
}  // namespace metaekf::filter
