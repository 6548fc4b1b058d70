#include "core/physics/projection.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <cmath>

#include "core/base/rng.h"

namespace metaekf::physics {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

MatrixXd Random(Index rows, Index cols, base::Rng* rng) {
  MatrixXd matrix(rows, cols);
  for (double& value : matrix.reshaped()) value = rng->Normal();
  return matrix;
}

MatrixXd RandomCovariance(Index n, base::Rng* rng) {
  const MatrixXd root = Random(n, n, rng);
  return root * root.transpose() + 0.1 * MatrixXd::Identity(n, n);
}

TEST(ProjectionTest, OnABoxItClips) {
  MatrixXd G(4, 2);
  G << 1, 0, -1, 0, 0, 1, 0, -1;
  const Polyhedron box = *MakePolyhedron(G, Eigen::Vector4d(1, 1, 1, 1));
  const Projection corner = Project(box, Eigen::Vector2d(3, -5), MatrixXd::Identity(2, 2));
  EXPECT_LT((corner.point - Eigen::Vector2d(1, -1)).norm(), 1e-15);
  EXPECT_EQ(corner.active.size(), 2u);
  const Projection inside = Project(box, Eigen::Vector2d(0.5, 0.25), MatrixXd::Identity(2, 2));
  EXPECT_EQ(inside.point, Eigen::Vector2d(0.5, 0.25));
  EXPECT_TRUE(inside.active.empty());
}

// By hand: x₁ ≥ x₂ violated by 2, taken up by both in proportion to their variances.
TEST(ProjectionTest, WhatIsLessSureMovesMore) {
  MatrixXd G(1, 2);
  G << -1, 1;
  const Polyhedron order = *MakePolyhedron(G, VectorXd::Zero(1));
  const Projection found = Project(order, Eigen::Vector2d(0, 2), Eigen::Vector2d(std::sqrt(3), 1).asDiagonal());
  EXPECT_LT((found.point - Eigen::Vector2d(1.5, 1.5)).norm(), 1e-14);
}

// The conditions of optimality of Karush, Kuhn and Tucker: feasible, and P⁻¹ (z − x) is made of active rows with λ ≥ 0.
TEST(ProjectionTest, IsTheOptimum) {
  int active = 0;
  for (uint64_t seed = 0; seed < 300; ++seed) {
    base::Rng rng(seed);
    const Index n = 2 + static_cast<Index>(seed % 5), m = 1 + static_cast<Index>(seed % 9);
    MatrixXd G = Random(m, n, &rng);
    if (m > 2 && seed % 4 == 0) G.row(m - 1) = G.row(0);
    const VectorXd g = seed % 2 == 0 ? VectorXd(VectorXd::Zero(m)) : VectorXd(Random(m, 1, &rng).cwiseAbs());
    const Polyhedron set = *MakePolyhedron(G, g);
    const MatrixXd cov = RandomCovariance(n, &rng);
    const VectorXd z = 3 * Random(n, 1, &rng);
    const Projection found = Project(set, z, MatrixXd(cov.llt().matrixL()));
    ASSERT_TRUE(Contains(set, found.point)) << "seed " << seed;
    // Optimal if no direction into the set leads downhill: for generators d from x, dᵀ P⁻¹ (x − z) ≥ 0.
    const VectorXd slope = cov.inverse() * (found.point - z);
    const auto expect_uphill = [&](const VectorXd& to) { EXPECT_GT(slope.dot(to - found.point), -1e-7 * (1 + slope.norm() * to.norm())) << "seed " << seed; };
    VectorXd vertex = VectorXd::Zero(n);
    if (set.vertices.cols() > 0) vertex = set.vertices.col(0);
    expect_uphill(vertex);
    for (Index k = 0; k < set.vertices.cols(); ++k) expect_uphill(set.vertices.col(k));
    for (Index k = 0; k < set.rays.cols(); ++k) expect_uphill(vertex + 100 * set.rays.col(k));
    for (Index k = 0; k < set.lineality.cols(); ++k) EXPECT_NEAR(slope.dot(set.lineality.col(k)), 0, 1e-7 * (1 + slope.norm()));
    active += found.active.size() > 1 ? 1 : 0;
  }
  EXPECT_GT(active, 50);
}

TEST(ProjectionTest, ADirectionWithoutVarianceStays) {
  MatrixXd G(1, 2);
  G << 1, 1;
  const Polyhedron set = *MakePolyhedron(G, VectorXd::Zero(1));
  const Projection found = Project(set, Eigen::Vector2d(1, 1), Eigen::Vector2d(0, 2).asDiagonal());
  EXPECT_LT((found.point - Eigen::Vector2d(1, -1)).norm(), 1e-14);
}

// Sizes from 1e-150 to 1e150, differences that cancel, points on the edge: always inside to rounding.
TEST(ProjectionTest, WhateverComesInEndsInside) {
  for (uint64_t seed = 0; seed < 3000; ++seed) {
    base::Rng rng(10000 + seed);
    const Index n = 2 + static_cast<Index>(seed % 6), m = 1 + static_cast<Index>(seed % 7);
    MatrixXd G = Random(m, n, &rng);
    if (seed % 3 == 0) {  // an order
      G.setZero();
      for (Index i = 0; i < m; ++i) G(i, i % n) = -1, G(i, (i + 1) % n) = 1;
    }
    const VectorXd g = seed % 2 == 0 ? VectorXd(VectorXd::Zero(m)) : VectorXd(Random(m, 1, &rng).cwiseAbs());
    const absl::StatusOr<Polyhedron> set = MakePolyhedron(G, g);
    ASSERT_TRUE(set.ok()) << set.status();
    VectorXd z = Random(n, 1, &rng);
    for (double& value : z) value *= std::pow(10.0, std::round(rng.Uniform(-150, 150) * (seed % 5 == 0 ? 1 : 0.05)));
    if (seed % 4 == 0) z.setConstant(z[0]);
    EXPECT_TRUE(Contains(*set, Inside(*set, z))) << "seed " << seed;
    EXPECT_TRUE(Contains(*set, Project(*set, z, MatrixXd(RandomCovariance(n, &rng).llt().matrixL())).point)) << "seed " << seed;
  }
}

}  // namespace
}  // namespace metaekf::physics
