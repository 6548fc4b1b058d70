#include "core/filter/gate.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/Cholesky>

#include "core/base/rng.h"
#include "core/filter/health.h"

namespace metaekf::filter {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

const std::vector<double> kLimits = {24, 28, 31};  // χ² at about one in a million

TEST(GateTest, TheComponentThatIsWrongIsLeftOut) {
  const MatrixXd S = MatrixXd{{4, 1, 0}, {1, 1, 0}, {0, 0, 9}};
  EXPECT_THAT(Outliers(VectorXd{{2, 1, 3}}, S, kLimits), testing::ElementsAre());
  EXPECT_THAT(Outliers(VectorXd{{2, 50, 3}}, S, kLimits), testing::ElementsAre(1));
  EXPECT_THAT(Outliers(VectorXd{{100, 1, -900}}, S, kLimits), testing::ElementsAre(0, 2));
  EXPECT_THAT(Outliers(VectorXd{{1e3, 1e3, 1e4}}, S, kLimits), testing::ElementsAre(0, 1, 2));
  EXPECT_THAT(Outliers(VectorXd{{std::nan(""), 1, 1}}, S, kLimits), testing::Contains(0));
}

TEST(GateTest, WideningMakesTheInnovationWhatIsExpected) {
  const MatrixXd A{{0.5, 0.2}, {0.2, 0.3}}, R{{0.1, 0}, {0, 0.2}};
  const VectorXd innovation{{8, -5}};
  const double widening = WideningFor(innovation, A, R);
  EXPECT_GT(widening, 1);
  EXPECT_NEAR(innovation.dot((widening * A + R).llt().solve(innovation)), 2, 1e-4);
  EXPECT_EQ(WideningFor(VectorXd{{0.1, 0.1}}, A, R), 1);
  // Nothing that the filter could be wrong about explains this component.
  EXPECT_NEAR(WideningFor(VectorXd{{0, 5}}, MatrixXd{{1, 0}, {0, 0}}, R), 1e12, 1e8);
}

TEST(NisMonitorTest, SaysWhichWayTheCovarianceIsWrong) {
  base::Rng rng(3);
  const auto judge = [&](double variance, int samples) {
    NisMonitor monitor;
    for (int t = 0; t < samples; ++t) monitor.Add(variance * (std::pow(rng.Normal(), 2) + std::pow(rng.Normal(), 2)), 2);
    return monitor.Judge();
  };
  int early_alarms = 0;
  for (int run = 0; run < 50; ++run) {
    EXPECT_EQ(judge(1, 1000), Health::kConsistent);
    EXPECT_EQ(judge(2, 1000), Health::kOverconfident);
    EXPECT_EQ(judge(0.5, 1000), Health::kUnderconfident);
    early_alarms += judge(1, 3) == Health::kConsistent ? 0 : 1;
  }
  EXPECT_LE(early_alarms, 1) << "at 99.9 % on both sides, 50 trials";
  EXPECT_EQ(NisMonitor().Judge(), Health::kConsistent);
}

TEST(NisMonitorTest, SaysWhetherInnovationsGoOnAsTheLast) {
  base::Rng rng(5);
  // w = ρ w of the last sample + √(1 − ρ²) white: as large as the covariance says where `scale` is 1.
  const auto judge = [&](double rho, double scale) {
    NisMonitor monitor(2);
    VectorXd w = VectorXd::Zero(2);
    for (int t = 0; t < 1000; ++t) {
      for (double& component : w) component = rho * component + std::sqrt(1 - rho * rho) * rng.Normal();
      monitor.Add(scale * scale * w.squaredNorm(), 2, scale * w);
    }
    return monitor.Judge();
  };
  for (int run = 0; run < 20; ++run) {
    EXPECT_EQ(judge(0, 1), Health::kConsistent);
    EXPECT_EQ(judge(0.6, 1), Health::kOverconfident);
    EXPECT_EQ(judge(0.6, 0.5), Health::kOverconfident) << "the error lasts, however wide the bounds";
    EXPECT_EQ(judge(0, 0.5), Health::kUnderconfident);
    EXPECT_EQ(judge(-0.6, 1), Health::kConsistent) << "corrected too much, but no error lasts";
  }
}

// An error of a fiftieth of the measurement's variance that lasts for twenty samples: the last innovation alone hardly shows it.
TEST(NisMonitorTest, SeesASmallErrorThatLasts) {
  base::Rng rng(8);
  constexpr double kRho = 0.95;
  const auto share_called = [&](double variance) {
    int called = 0;
    for (int run = 0; run < 100; ++run) {
      NisMonitor monitor(2);
      VectorXd error = VectorXd::Zero(2), w(2);
      for (int t = 0; t < 400; ++t) {
        for (Eigen::Index i = 0; i < 2; ++i) {
          error[i] = kRho * error[i] + std::sqrt((1 - kRho * kRho) * variance) * rng.Normal();
          w[i] = rng.Normal() + error[i];
        }
        monitor.Add(w.squaredNorm(), 2, w);
        if (monitor.Correlated()) {
          ++called;
          break;
        }
      }
    }
    return called / 100.0;
  };
  EXPECT_LE(share_called(0), 0.1) << "at 99.95 %, at 400 samples that overlap";
  EXPECT_GE(share_called(0.15), 0.8);
}

TEST(NisMonitorTest, SamplesThatAreNotMeasuredAsAWholeLeaveTheCorrelationAsItIs) {
  NisMonitor monitor(2);
  const VectorXd w{{1, 1}};
  for (int t = 0; t < 30; ++t) monitor.Add(2, 2, w);
  EXPECT_TRUE(monitor.Correlated());
  const double before = monitor.correlation;
  monitor.Add(1, 1);
  EXPECT_EQ(monitor.correlation, before);
  EXPECT_EQ(monitor.pairs, 29);
}

TEST(NisMonitorTest, ForgetsWhatIsLongAgo) {
  NisMonitor monitor;
  for (int t = 0; t < 100; ++t) monitor.Add(9, 1);
  EXPECT_EQ(monitor.Judge(), Health::kOverconfident);
  for (int t = 0; t < 600; ++t) monitor.Add(1, 1);
  EXPECT_EQ(monitor.Judge(), Health::kConsistent);
  EXPECT_NEAR(monitor.Ratio(), 1, 0.03);
}

}  // namespace
}  // namespace metaekf::filter
