#include "core/filter/replay.h"

#include <gtest/gtest.h>

#include "tests/core/filter/linear_filter.h"

namespace metaekf::filter {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

struct Replaying {
  explicit Replaying(const nssm::Bundle& bundle, int64_t lag)
      : plain(bundle), filter(plain.ekf, lag), estimate(plain.ekf.MakeEstimate()) {}
  Filter plain;  // only for its scratch and its start
  ReplayFilter filter;
  Estimate estimate;
};

// The second sensor comes up to five samples late, at random, in any order: once all is there, the filter is where it would have
// been had nothing been late.
TEST(ReplayTest, LateMeasurementsLeadWhereTimelyOnesWould) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  Filter timely(bundle);
  Replaying late(bundle, 5);
  LinearTruth truth(LinearSystem(), 3);
  struct Pending {
    int due, of;
    double value;
  };
  std::vector<Pending> pending;
  const MatrixXd R = 2 * LinearSystem().R;
  for (int t = 0; t < 300; ++t) {
    const VectorXd u = RandomVector(&truth.rng, 1), y = truth.Measure();
    const int delay = t < 290 ? static_cast<int>(truth.rng.Index(6)) : 0;
    // Now and then with an R of its own, which a component that comes later does not share.
    const MatrixXd* own = t % 7 == 0 ? &R : nullptr;
    ASSERT_TRUE(late.filter.Step(u, delay == 0 ? y : VectorXd{{y[0], kNaN}}, late.plain.scratch.get(), &late.estimate, own).ok());
    if (delay > 0) pending.push_back({t + delay, t, y[1]});
    for (const Pending& one : pending) {
      if (one.due != t) continue;
      ASSERT_TRUE(late.filter.StepDelayed(t - one.of, VectorXd{{kNaN, one.value}}, late.plain.scratch.get(), &late.estimate).ok());
    }
    MatrixXd merged = own != nullptr ? *own : LinearSystem().R;
    if (own != nullptr && delay > 0) {
      merged(0, 1) = merged(1, 0) = 0;
      merged(1, 1) = LinearSystem().R(1, 1);
    }
    ASSERT_TRUE(timely.ekf.Step(u, y, timely.scratch.get(), &timely.estimate, &merged).ok());
    truth.Advance(u[0]);
  }
  EXPECT_LT((late.filter.ekf().state().mean - timely.ekf.state().mean).norm(), 1e-12);
  EXPECT_LT((late.filter.ekf().state().factor - timely.ekf.state().factor).norm(), 1e-12);
}

TEST(ReplayTest, TheEstimateOfALateMeasurementIsThatOfItsTime) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  Filter timely(bundle);
  Replaying late(bundle, 3);
  const VectorXd u{{0.4}}, half{{1, kNaN}}, whole{{1, -2}};
  for (int t = 0; t < 4; ++t) ASSERT_TRUE(late.filter.Step(u, half, late.plain.scratch.get(), &late.estimate).ok());
  ASSERT_TRUE(timely.ekf.Step(u, half, timely.scratch.get(), &timely.estimate).ok());
  ASSERT_TRUE(timely.ekf.Step(u, whole, timely.scratch.get(), &timely.estimate).ok());
  ASSERT_TRUE(late.filter.StepDelayed(2, VectorXd{{kNaN, -2}}, late.plain.scratch.get(), &late.estimate).ok());
  EXPECT_EQ(late.estimate.mean, timely.estimate.mean);
  EXPECT_EQ(late.estimate.cov, timely.estimate.cov);
}

TEST(ReplayTest, RemembersNoMoreThanItsLag) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  Replaying late(bundle, 3), none(bundle, 0);
  for (int t = 0; t < 10; ++t) {
    ASSERT_TRUE(late.filter.Step(VectorXd{{0.1}}, VectorXd{{1, 1}}, late.plain.scratch.get(), &late.estimate).ok());
    ASSERT_TRUE(none.filter.Step(VectorXd{{0.1}}, VectorXd{{1, 1}}, none.plain.scratch.get(), &none.estimate).ok());
    EXPECT_EQ(late.filter.remembered(), std::min(t + 1, 4));
    EXPECT_EQ(none.filter.remembered(), 0);
  }
}

TEST(ReplayTest, ABadMeasurementChangesNothing) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  Replaying late(bundle, 3);
  for (int t = 0; t < 4; ++t) ASSERT_TRUE(late.filter.Step(VectorXd{{0.1}}, VectorXd{{1, kNaN}}, late.plain.scratch.get(), &late.estimate).ok());
  const FilterState before = late.filter.ekf().state();
  const double inf = std::numeric_limits<double>::infinity();
  EXPECT_FALSE(late.filter.StepDelayed(1, VectorXd{{kNaN, inf}}, late.plain.scratch.get(), &late.estimate).ok());
  EXPECT_EQ(late.filter.ekf().state().mean, before.mean);
  EXPECT_TRUE(std::isnan(late.filter.Samples()[2].output[1]));
}

TEST(ReplayTest, ARestoredFilterGoesOnBitForBit) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  Replaying a(bundle, 4), b(bundle, 4);
  base::Rng rng(5);
  for (int t = 0; t < 30; ++t) {
    const VectorXd u = RandomVector(&rng, 1), y{{rng.Normal(), kNaN}}, delayed{{kNaN, rng.Normal()}};
    if (t == 17) {
      ASSERT_TRUE(b.filter.Restore(a.filter.oldest_state(), a.filter.Samples(), b.plain.scratch.get()).ok());
    }
    ASSERT_TRUE(a.filter.Step(u, y, a.plain.scratch.get(), &a.estimate).ok());
    if (t >= 4) {
      ASSERT_TRUE(a.filter.StepDelayed(3, delayed, a.plain.scratch.get(), &a.estimate).ok());
    }
    if (t < 17) continue;
    ASSERT_TRUE(b.filter.Step(u, y, b.plain.scratch.get(), &b.estimate).ok());
    ASSERT_TRUE(b.filter.StepDelayed(3, delayed, b.plain.scratch.get(), &b.estimate).ok());
    EXPECT_EQ(a.filter.ekf().state().mean, b.filter.ekf().state().mean);
    EXPECT_EQ(a.filter.ekf().state().factor, b.filter.ekf().state().factor);
    EXPECT_EQ(a.estimate.mean, b.estimate.mean);
  }
}

}  // namespace
}  // namespace metaekf::filter
