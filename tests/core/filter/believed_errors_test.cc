#include "core/filter/believed_errors.h"

#include <gtest/gtest.h>

#include "tests/core/filter/linear_filter.h"

namespace metaekf::filter {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr int kDraws = 20000;

MatrixXd SecondMoment(const MatrixXd& a, const MatrixXd& b) { return a * b.transpose() / kDraws; }

/// Entries to a few of their own standard errors.
void ExpectNear(const MatrixXd& found, const MatrixXd& expected, const VectorXd& deviations) {
  for (Index i = 0; i < found.rows(); ++i) {
    for (Index j = 0; j < found.cols(); ++j) {
      EXPECT_NEAR(found(i, j), expected(i, j), 5 * std::sqrt(2.0 / kDraws) * deviations[i] * deviations[j]) << i << ", " << j;
    }
  }
}

// Of a linear system with errors that last, some of whose outputs are missing: at every step errors have the covariance of the filter, and
// from one to the next what (I − K H) F leaves of it, with K from the textbook.
TEST(BelievedErrorsTest, HaveTheFiltersCovarianceAndGoOnAsItsErrorsDo) {
  Filter filter(ErringSystem().Known());
  StepTrace trace;
  filter.ekf.set_trace(&trace);
  BelievedErrors believed(kDraws, base::Rng(4));
  base::Rng rng(3);
  const Index n = filter.ekf.joint().size();
  MatrixXd before, P_before;
  for (int t = 0; t < 12; ++t) {
    VectorXd y = RandomVector(&rng, 2);
    if (t % 3 == 1) y[0] = std::numeric_limits<double>::quiet_NaN();
    if (t % 5 == 4) y.setConstant(std::numeric_limits<double>::quiet_NaN());
    ASSERT_TRUE(filter.ekf.Step(RandomVector(&rng, 1), y, filter.scratch.get(), &filter.estimate).ok());
    believed.Follow(filter.ekf, trace);
    const MatrixXd P = filter.ekf.state().factor * filter.ekf.state().factor.transpose();
    const VectorXd deviations = P.diagonal().cwiseSqrt();
    ExpectNear(SecondMoment(believed.errors(), believed.errors()), P, deviations);
    if (t > 0) {
      const MatrixXd Q = filter.ekf.process_factor() * filter.ekf.process_factor().transpose();
      const MatrixXd prior = trace.F * P_before * trace.F.transpose() + Q;
      std::vector<Index> rows;
      for (Index i = 0; i < 2; ++i) {
        if (!std::isnan(y[i])) rows.push_back(i);
      }
      MatrixXd H(2, n);
      VectorXd h(2);
      filter.ekf.joint().Measurement(filter.ekf.state().mean, filter.ekf.state().last_input, &h, &H, filter.scratch.get());
      MatrixXd left = MatrixXd::Identity(n, n);
      if (!rows.empty()) {
        const MatrixXd H_m = H(rows, Eigen::all), R = filter.ekf.MeasurementNoise()(rows, rows);
        left -= prior * H_m.transpose() * (H_m * prior * H_m.transpose() + R).inverse() * H_m;
      }
      const MatrixXd cross = left * trace.F * P_before;
      const MatrixXd found = SecondMoment(believed.errors(), before);
      for (Index i = 0; i < n; ++i) {
        for (Index j = 0; j < n; ++j) {
          EXPECT_NEAR(found(i, j), cross(i, j), 5 * std::sqrt(2.0 / kDraws) * deviations[i] * std::sqrt(P_before(j, j))) << t;
        }
      }
    }
    before = believed.errors();
    P_before = P;
  }
}

TEST(BelievedErrorsTest, WhatIsKnownExactlyHasNoError) {
  LinearSystem system;
  system.Q = MatrixXd{{0.02, 0}, {0, 0}};
  system.P0.setZero();
  Filter filter(LinearBundle(system));
  StepTrace trace;
  filter.ekf.set_trace(&trace);
  BelievedErrors believed(10, base::Rng(4));
  for (int t = 0; t < 4; ++t) {
    ASSERT_TRUE(filter.ekf.Step(VectorXd::Zero(1), VectorXd::Zero(2), filter.scratch.get(), &filter.estimate).ok());
    believed.Follow(filter.ekf, trace);
    EXPECT_TRUE(believed.errors().allFinite());
    if (t == 0) {
      EXPECT_TRUE(believed.errors().isZero(0));
    }
  }
}

}  // namespace
}  // namespace metaekf::filter
