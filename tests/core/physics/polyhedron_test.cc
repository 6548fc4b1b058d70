#include "core/physics/polyhedron.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <set>
#include <vector>

#include "core/base/rng.h"
#include "core/linalg/decompositions.h"

namespace metaekf::physics {
namespace {

using ::testing::HasSubstr;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

MatrixXd Small(Index rows, Index cols, base::Rng* rng) {
  MatrixXd matrix(rows, cols);
  for (double& value : matrix.reshaped()) value = std::round(3 * rng->Normal());
  return matrix;
}

/// Columns as sorted, rounded tuples, for sets to be compared.
std::set<std::vector<int64_t>> AsSet(const MatrixXd& columns) {
  std::set<std::vector<int64_t>> result;
  for (Index k = 0; k < columns.cols(); ++k) {
    std::vector<int64_t> column;
    for (Index i = 0; i < columns.rows(); ++i) column.push_back(std::llround(1234567.891 * columns(i, k)));  // no fraction lies between two
    result.insert(column);
  }
  return result;
}

/// Calls visit with every way to choose `count` of the rows 0 … size − 1.
template <typename Visit>
void ForEachChoice(Index size, Index count, const Visit& visit, std::vector<Index> chosen = {}) {
  if (static_cast<Index>(chosen.size()) == count) return visit(chosen);
  for (Index i = chosen.empty() ? 0 : chosen.back() + 1; i < size; ++i) {
    std::vector<Index> more = chosen;
    more.push_back(i);
    ForEachChoice(size, count, visit, more);
  }
}

/// Of a set without lineality, by trying every choice of planes.
MatrixXd VerticesByBruteForce(const MatrixXd& G, const VectorXd& g) {
  const Index n = G.cols();
  std::vector<VectorXd> found;
  ForEachChoice(G.rows(), n, [&](const std::vector<Index>& rows) {
    const MatrixXd planes = G(rows, Eigen::all);
    if (linalg::DecomposeSingularValues(planes).values.minCoeff() < 1e-9) return;
    const VectorXd x = linalg::SolveLeastSquares(planes, MatrixXd(g(rows)));
    if ((G * x - g).maxCoeff() < 1e-7) found.push_back(x);
  });
  MatrixXd vertices(n, static_cast<Index>(found.size()));
  for (size_t k = 0; k < found.size(); ++k) vertices.col(static_cast<Index>(k)) = found[k];
  return vertices;
}

MatrixXd RaysByBruteForce(const MatrixXd& G) {
  const Index n = G.cols();
  std::vector<VectorXd> found;
  ForEachChoice(G.rows(), n - 1, [&](const std::vector<Index>& rows) {
    MatrixXd planes = MatrixXd::Zero(n, n);
    planes.topRows(n - 1) = G(rows, Eigen::all);
    const linalg::SingularValues svd = linalg::DecomposeSingularValues(planes);
    if (svd.values[n - 2] < 1e-9) return;
    for (const double sign : {1.0, -1.0}) {
      const VectorXd ray = sign * svd.v.col(n - 1);
      if ((G * ray).maxCoeff() < 1e-9) found.push_back(ray / ray.cwiseAbs().maxCoeff());
    }
  });
  MatrixXd rays(n, static_cast<Index>(found.size()));
  for (size_t k = 0; k < found.size(); ++k) rays.col(static_cast<Index>(k)) = found[k];
  return rays;
}

TEST(PolyhedronTest, TheOrthantIsItsAxes) {
  const Polyhedron set = *MakePolyhedron(-MatrixXd::Identity(3, 3), VectorXd::Zero(3));
  EXPECT_EQ(AsSet(set.rays), AsSet(MatrixXd::Identity(3, 3)));
  EXPECT_EQ(set.vertices.cols(), 0);
  EXPECT_EQ(set.lineality.cols(), 0);
}

TEST(PolyhedronTest, ABoxIsItsCorners) {
  MatrixXd G(4, 2);
  G << 1, 0, -1, 0, 0, 1, 0, -1;
  const Polyhedron set = *MakePolyhedron(G, Eigen::Vector4d(2, 1, 5, -3));
  MatrixXd corners(2, 4);
  corners << 2, 2, -1, -1, 5, 3, 5, 3;
  EXPECT_EQ(AsSet(set.vertices), AsSet(corners));
  EXPECT_EQ(set.rays.cols(), 0);
}

// Pressures that do not rise along the flow, by hand: the first k are one higher than the rest, but for the mean of all.
TEST(PolyhedronTest, AnOrderOfPressuresHasStepsAndFreeDirections) {
  constexpr Index kVolumes = 8, kStates = 24;
  MatrixXd G = MatrixXd::Zero(kVolumes - 1, kStates);
  for (Index i = 0; i + 1 < kVolumes; ++i) {
    G(i, i) = -1;
    G(i, i + 1) = 1;
  }
  const Polyhedron set = *MakePolyhedron(G, VectorXd::Zero(kVolumes - 1));
  ASSERT_EQ(set.rays.cols(), kVolumes - 1);
  EXPECT_EQ(set.lineality.cols(), 17);
  MatrixXd steps = MatrixXd::Zero(kStates, kVolumes - 1);
  for (Index k = 0; k + 1 < kVolumes; ++k) {
    steps.col(k).head(k + 1).setOnes();
    steps.col(k).head(kVolumes).array() -= static_cast<double>(k + 1) / kVolumes;
    steps.col(k) /= steps.col(k).cwiseAbs().maxCoeff();
  }
  EXPECT_EQ(AsSet(set.rays), AsSet(steps));
  EXPECT_LT((G * set.lineality).norm(), 1e-12);
}

TEST(PolyhedronTest, RandomConesHaveTheRaysOfBruteForce) {
  for (uint64_t seed = 0; seed < 200; ++seed) {
    base::Rng rng(seed);
    const Index n = 2 + static_cast<Index>(seed % 4), m = n + static_cast<Index>(seed % 5);
    MatrixXd G = Small(m, n, &rng);
    if (seed % 3 == 0) G.row(m - 1) = G.row(0);          // twice the same
    if (seed % 7 == 0) G.row(m - 1) = G.row(0) + G.row(1);  // follows from two others
    const absl::StatusOr<Polyhedron> set = MakePolyhedron(G, VectorXd::Zero(m));
    ASSERT_TRUE(set.ok()) << set.status();
    if (set->lineality.cols() > 0) continue;  // brute force knows none
    EXPECT_EQ(AsSet(set->rays), AsSet(RaysByBruteForce(G))) << "seed " << seed << "\n" << G;
  }
}

TEST(PolyhedronTest, RandomSetsHaveTheVerticesOfBruteForce) {
  int bounded = 0, empty = 0;
  for (uint64_t seed = 0; seed < 300; ++seed) {
    base::Rng rng(1000 + seed);
    const Index n = 2 + static_cast<Index>(seed % 3), m = n + 1 + static_cast<Index>(seed % 5);
    const MatrixXd G = Small(m, n, &rng);
    const VectorXd g = Small(m, 1, &rng);
    const absl::StatusOr<Polyhedron> set = MakePolyhedron(G, g);
    const MatrixXd expected = VerticesByBruteForce(G, g);
    if (!set.ok()) {
      EXPECT_EQ(expected.cols(), 0) << "seed " << seed;
      ++empty;
      continue;
    }
    if (set->lineality.cols() > 0) continue;
    MatrixXd vertices = set->vertices;
    if (vertices.cols() == 0) vertices = VectorXd::Zero(n);  // a cone's
    EXPECT_EQ(AsSet(vertices), AsSet(expected)) << "seed " << seed << "\n" << G << "\n\n" << g;
    EXPECT_EQ(AsSet(set->rays), AsSet(RaysByBruteForce(G))) << "seed " << seed;
    bounded += set->rays.cols() == 0 ? 1 : 0;
  }
  EXPECT_GT(bounded, 20);
  EXPECT_GT(empty, 20);
}

TEST(PolyhedronTest, WhatIsMadeOfTheGeneratorsIsInside) {
  for (uint64_t seed = 0; seed < 100; ++seed) {
    base::Rng rng(2000 + seed);
    const Index n = 4, m = 1 + static_cast<Index>(seed % 8);
    const MatrixXd G = Small(m, n, &rng);
    const absl::StatusOr<Polyhedron> set = MakePolyhedron(G, Small(m, 1, &rng).cwiseAbs());
    ASSERT_TRUE(set.ok()) << set.status();  // 0 is in it
    VectorXd x = VectorXd::Zero(n);
    for (Index k = 0; k < set->rays.cols(); ++k) x += std::fabs(rng.Normal()) * set->rays.col(k);
    for (Index k = 0; k < set->vertices.cols(); ++k) x += set->vertices.col(k) / static_cast<double>(set->vertices.cols());
    for (Index k = 0; k < set->lineality.cols(); ++k) x += rng.Normal() * set->lineality.col(k);
    EXPECT_LT((set->G * x - set->g).maxCoeff(), 1e-9) << "seed " << seed;
    // Rays and vertices do not lean on the free directions.
    EXPECT_LT((set->lineality.transpose() * set->rays).norm() + (set->lineality.transpose() * set->vertices).norm(), 1e-9);
  }
}

TEST(PolyhedronTest, ACopyOfItsRaysIsTheSameCone) {
  for (uint64_t seed = 0; seed < 50; ++seed) {
    base::Rng rng(3000 + seed);
    const Polyhedron set = *MakePolyhedron(Small(5, 3, &rng), VectorXd::Zero(5));
    if (set.lineality.cols() > 0) continue;
    MatrixXd rays(3, set.rays.cols() + 1);
    rays << 3 * set.rays, set.rays.rowwise().sum();  // and one that the others make up
    EXPECT_EQ(AsSet(ConeOfRays(rays)->rays), AsSet(set.rays)) << "seed " << seed;
  }
}

TEST(PolyhedronTest, NothingLeftIsRefusedByTheRowThatDoesIt) {
  MatrixXd G(3, 1);
  G << 1, 5, -1;
  const absl::Status status = MakePolyhedron(G, Eigen::Vector3d(1, 20, -2)).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(status.message()), HasSubstr("row 3"));
  const absl::Status zero = MakePolyhedron(MatrixXd::Zero(1, 2), VectorXd::Constant(1, -1)).status();  // 0 ≤ −1
  EXPECT_THAT(std::string(zero.message()), HasSubstr("row 1"));
}

TEST(PolyhedronTest, WithoutConstraintsEverythingIsFree) {
  const Polyhedron set = *MakePolyhedron(MatrixXd(0, 3), VectorXd(0));
  EXPECT_EQ(set.lineality.cols(), 3);
  EXPECT_EQ(set.rays.cols(), 0);
}

TEST(PolyhedronTest, ContainsAllowsForRoundingAndNoMore) {
  MatrixXd G(1, 2);
  G << 1, -1;
  const Polyhedron set = *MakePolyhedron(G, VectorXd::Zero(1));
  EXPECT_TRUE(Contains(set, Eigen::Vector2d(1e6, 1e6 * (1 - 1e-15))));
  EXPECT_FALSE(Contains(set, Eigen::Vector2d(1e6, 1e6 * (1 - 1e-13))));
  EXPECT_FALSE(Contains(set, Eigen::Vector2d(NAN, 0)));
}

}  // namespace
}  // namespace metaekf::physics
