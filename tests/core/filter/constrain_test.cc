#include "core/filter/constrain.h"

#include <gtest/gtest.h>

#include <Eigen/Eigenvalues>
#include <cmath>

#include "core/base/rng.h"

namespace metaekf::filter {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

physics::Polyhedron Below(double bound) {
  return *physics::MakePolyhedron(MatrixXd::Identity(1, 1), VectorXd::Constant(1, bound));
}

// By quadrature: ∫ t² over t > 0 of the normal density at −α, divided by its mass there.
TEST(ConstrainTest, TheEdgeVarianceIsThatOfATruncatedNormal) {
  for (const double alpha : {0.0, 0.1, 0.5, 1.0, 2.0, 4.0, 8.0, 15.0}) {
    double mass = 0, moment = 0;
    const double step = 1e-4;
    for (double t = step / 2; t < 10; t += step) {
      const double weight = std::exp(-0.5 * t * t - alpha * t);  // of the density at −α, less a factor
      mass += weight;
      moment += t * t * weight;
    }
    EXPECT_NEAR(EdgeVariance(alpha) / (moment / mass), 1, 1e-5) << alpha;
  }
  EXPECT_NEAR(EdgeVariance(20.0001) / EdgeVariance(19.9999), 1, 1e-4);  // the series goes on where the formula ends
}

TEST(ConstrainTest, WhatIsInsideIsLeftAsItIs) {
  VectorXd mean = VectorXd::Constant(1, 0.5);
  MatrixXd factor = MatrixXd::Constant(1, 1, 2);
  const ConstraintEffect effect = Constrain(Below(1), &mean, &factor);
  EXPECT_EQ(effect.slack, 0.5);
  EXPECT_EQ(effect.projection, 0);
  EXPECT_EQ(mean[0], 0.5);
  EXPECT_EQ(factor(0, 0), 2);
}

TEST(ConstrainTest, WhatIsOutsideGoesToTheEdgeAndIsSurer) {
  VectorXd mean = VectorXd::Constant(1, 3);
  MatrixXd factor = MatrixXd::Constant(1, 1, 2);
  const ConstraintEffect effect = Constrain(Below(1), &mean, &factor);
  EXPECT_EQ(effect.slack, -2);
  EXPECT_NEAR(effect.projection, 2, 1e-15);
  EXPECT_NEAR(mean[0], 1, 1e-15);
  EXPECT_NEAR(factor(0, 0) * factor(0, 0), 4 * EdgeVariance(1), 1e-12);
}

// The truth drawn from N(x, P) inside the set: the mean square error about the edge is P⁺. One constraint, three states.
TEST(ConstrainTest, TheCovarianceIsTheErrorOfTruthsInside) {
  base::Rng rng(3);
  MatrixXd G(1, 3);
  G << 1, -0.5, 0.25;
  const physics::Polyhedron set = *physics::MakePolyhedron(G, VectorXd::Constant(1, 0.2));
  MatrixXd factor(3, 3);
  factor << 1, 0, 0, 0.4, 0.7, 0, -0.3, 0.2, 0.5;
  const VectorXd mean = Eigen::Vector3d(1.5, 0.1, -0.2);
  VectorXd constrained = mean;
  MatrixXd narrowed = factor;
  Constrain(set, &constrained, &narrowed);
  MatrixXd errors = MatrixXd::Zero(3, 3);
  int count = 0;
  for (int k = 0; k < 400000; ++k) {
    VectorXd truth(3);
    for (double& value : truth) value = rng.Normal();
    truth = mean + factor * truth;
    if ((G * truth)[0] > 0.2) continue;
    errors += (truth - constrained) * (truth - constrained).transpose();
    ++count;
  }
  errors /= count;
  EXPECT_GT(count, 10000);
  EXPECT_LT((errors - narrowed * narrowed.transpose()).norm(), 0.03 * errors.norm());
}

TEST(ConstrainTest, TheMeanIsInsideAndTheCovarianceNoLarger) {
  for (uint64_t seed = 0; seed < 200; ++seed) {
    base::Rng rng(seed);
    const Index n = 3, m = 1 + static_cast<Index>(seed % 5);
    MatrixXd G(m, n), factor = MatrixXd::Zero(n, n);
    for (double& value : G.reshaped()) value = rng.Normal();
    for (Index i = 0; i < n; ++i) {
      for (Index j = 0; j <= i; ++j) factor(i, j) = rng.Normal();
    }
    VectorXd mean(n);
    for (double& value : mean) value = 3 * rng.Normal();
    const physics::Polyhedron set = *physics::MakePolyhedron(G, VectorXd::Constant(m, 0.5));
    const MatrixXd before = factor * factor.transpose();
    Constrain(set, &mean, &factor);
    EXPECT_TRUE(physics::Contains(set, mean)) << seed;
    const MatrixXd gained = before - factor * factor.transpose();
    EXPECT_GT(Eigen::SelfAdjointEigenSolver<MatrixXd>(gained).eigenvalues().minCoeff(), -1e-12 * before.norm()) << seed;
    EXPECT_EQ(factor(0, 1), 0);
  }
}

TEST(ConstrainTest, ASetInOtherUnitsIsTheSameSet) {
  MatrixXd G(1, 2);
  G << 1, -1;
  const physics::Polyhedron set = *physics::MakePolyhedron(G, VectorXd::Zero(1));
  const VectorXd mean = Eigen::Vector2d(10, 5), scale = Eigen::Vector2d(2, 3);
  const physics::Polyhedron units = InUnits(set, mean, scale);
  for (const Eigen::Vector2d& x : {Eigen::Vector2d(1, 2), Eigen::Vector2d(2, 1), Eigen::Vector2d(-4, 7)}) {
    const VectorXd normalised = (x - mean).cwiseQuotient(scale);
    EXPECT_EQ(physics::Contains(units, normalised), physics::Contains(set, x));
  }
}

}  // namespace
}  // namespace metaekf::filter
