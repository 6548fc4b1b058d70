#include "core/base/rng.h"

#include <gtest/gtest.h>

#include <cmath>

namespace metaekf::base {
namespace {

TEST(RngTest, SameSeedAndStreamGiveTheSameNumbers) {
  Rng a(7, 3), b(7, 3);
  for (int i = 0; i < 100; ++i) EXPECT_EQ(a.NextBits(), b.NextBits());
}

TEST(RngTest, StreamsAndSeedsDiffer) {
  EXPECT_NE(Rng(7, 0).NextBits(), Rng(7, 1).NextBits());
  EXPECT_NE(Rng(7, 1).NextBits(), Rng(8, 0).NextBits());
}

TEST(RngTest, StateRestoresTheSequenceIncludingTheSpareNormal) {
  Rng a(1);
  a.Normal();
  Rng b = Rng::FromState(a.state());
  for (int i = 0; i < 5; ++i) EXPECT_EQ(a.Normal(), b.Normal());
}

// 10⁵ draws: the mean of N(0,1) has standard error 0.0032, the variance 0.0045, that of U(0,1) 0.0009.
TEST(RngTest, MomentsMatchTheDistributions) {
  Rng rng(11);
  const int n = 100000;
  double sum = 0, square = 0, uniform = 0;
  for (int i = 0; i < n; ++i) {
    const double z = rng.Normal();
    sum += z;
    square += z * z;
    uniform += rng.Uniform();
  }
  EXPECT_NEAR(sum / n, 0, 0.015);
  EXPECT_NEAR(square / n, 1, 0.02);
  EXPECT_NEAR(uniform / n, 0.5, 0.004);
}

TEST(RngTest, IndexCoversItsRange) {
  Rng rng(5);
  int seen[3] = {0, 0, 0};
  for (int i = 0; i < 300; ++i) ++seen[rng.Index(3)];
  for (int count : seen) EXPECT_GT(count, 60);
}

}  // namespace
}  // namespace metaekf::base
