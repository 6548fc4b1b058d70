#include "core/filter/ekf.h"

#include <gtest/gtest.h>

#include "tests/core/filter/linear_filter.h"

namespace metaekf::filter {
namespace {

using Eigen::VectorXd;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

TEST(EkfGateTest, OutliersAreLeftOutComponentByComponent) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  Filter filter(bundle), without(bundle);
  LinearTruth truth(LinearSystem(), 5);
  for (int t = 0; t < 200; ++t) {
    const VectorXd u = RandomVector(&truth.rng, 1);
    VectorXd y = truth.Measure(), spared = y;
    if (t % 20 == 10) {
      y[1] += 1e4;
      spared[1] = kNaN;
    }
    ASSERT_TRUE(filter.ekf.Step(u, y, filter.scratch.get(), &filter.estimate).ok());
    ASSERT_TRUE(without.ekf.Step(u, spared, without.scratch.get(), &without.estimate).ok());
    EXPECT_EQ(filter.estimate.gated, t % 20 == 10 ? 1 : 0);
    if (t % 20 == 10) {
      EXPECT_GT(filter.estimate.nis, 1e4);
      EXPECT_GT(filter.estimate.innovation[1], 9e3);
    }
    // As if the wrong component had not been measured.
    EXPECT_LT((filter.estimate.mean - without.estimate.mean).norm(), 1e-12);
    EXPECT_LT((filter.estimate.cov - without.estimate.cov).norm(), 1e-12);
    EXPECT_EQ(filter.estimate.health, Health::kConsistent);
    truth.Advance(u[0]);
  }
}

TEST(EkfGateTest, AJumpIsBelievedAfterFiveSamples) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  Filter filter(bundle);
  LinearTruth truth(LinearSystem(), 6);
  std::vector<int> gated_at, reset_at;
  for (int t = 0; t < 140; ++t) {
    if (t == 100) truth.state[0] += 1000;  // someone has carried the system elsewhere
    const VectorXd u = RandomVector(&truth.rng, 1);
    ASSERT_TRUE(filter.ekf.Step(u, truth.Measure(), filter.scratch.get(), &filter.estimate).ok());
    if (filter.estimate.gated > 0) gated_at.push_back(t);
    if (filter.estimate.reset) {
      reset_at.push_back(t);
      EXPECT_LT((filter.estimate.mean - truth.state).norm(), 5);
      EXPECT_EQ(filter.estimate.health, Health::kOverconfident);
    }
    truth.Advance(u[0]);
  }
  EXPECT_EQ(gated_at, (std::vector<int>{100, 101, 102, 103, 104}));
  EXPECT_EQ(reset_at, std::vector<int>{105});
}

TEST(EkfGateTest, AnOverconfidentFilterDoesNotLockMeasurementsOut) {
  nssm::Bundle bundle = LinearBundle(LinearSystem());
  bundle.noise.process *= 1e-4;
  bundle.noise.measurement *= 1e-4;  // a hundredth of the true deviations
  Filter filter(bundle);
  LinearTruth truth(LinearSystem(), 7);
  int gated = 0;
  double squares = 0;
  for (int t = 0; t < 600; ++t) {
    const VectorXd u = RandomVector(&truth.rng, 1);
    ASSERT_TRUE(filter.ekf.Step(u, truth.Measure(), filter.scratch.get(), &filter.estimate).ok());
    if (t >= 100) {
      gated += filter.estimate.gated;
      squares += (filter.estimate.mean - truth.state).squaredNorm();
      EXPECT_EQ(filter.estimate.health, Health::kOverconfident);
    }
    truth.Advance(u[0]);
  }
  EXPECT_LE(gated, 10);
  EXPECT_LT(std::sqrt(squares / 500), 1);
}

TEST(EkfGateTest, BeginsAnewAfterADivergenceUnlessToldNotTo) {
  for (const bool restart : {true, false}) {
    nssm::Bundle bundle = LinearBundle(LinearSystem());
    Filter filter(bundle, {.gate = {.probability = 0}, .restart_after_divergence = restart});
    const VectorXd u{{0.1}}, y{{0.2, 0.1}};
    ASSERT_TRUE(filter.ekf.Step(u, y, filter.scratch.get(), &filter.estimate).ok());
    const VectorXd first = filter.estimate.mean;
    ASSERT_TRUE(filter.ekf.Step(VectorXd{{1e308}}, y, filter.scratch.get(), &filter.estimate).ok());
    ASSERT_TRUE(filter.ekf.Step(VectorXd{{1e308}}, VectorXd{{1e308, -1e308}}, filter.scratch.get(), &filter.estimate).ok());
    for (int t = 0; t < 5 && filter.estimate.health != Health::kDiverged; ++t) {
      ASSERT_TRUE(filter.ekf.Step(VectorXd{{1e308}}, VectorXd{{1e308, -1e308}}, filter.scratch.get(), &filter.estimate).ok());
    }
    ASSERT_EQ(filter.estimate.health, Health::kDiverged);
    ASSERT_TRUE(filter.ekf.Step(u, y, filter.scratch.get(), &filter.estimate).ok());
    EXPECT_EQ(filter.estimate.reset, restart);
    EXPECT_EQ(filter.estimate.health, restart ? Health::kConsistent : Health::kDiverged);
    if (restart) {
      EXPECT_EQ(filter.estimate.mean, first);
    }
  }
}

}  // namespace
}  // namespace metaekf::filter
