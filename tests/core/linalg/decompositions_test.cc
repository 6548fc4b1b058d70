#include "core/linalg/decompositions.h"

#include <cblas.h>
#include <gtest/gtest.h>

#include <Eigen/LU>
#include <algorithm>
#include <complex>
#include <limits>

#include "core/base/rng.h"

namespace metaekf::linalg {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

MatrixXd Random(Index rows, Index cols, uint64_t seed) {
  base::Rng rng(seed);
  return MatrixXd::NullaryExpr(rows, cols, [&] { return rng.Normal(); });
}

double Difference(const MatrixXd& a, const MatrixXd& b) { return (a - b).cwiseAbs().maxCoeff(); }

class SizeTest : public ::testing::TestWithParam<Index> {};
INSTANTIATE_TEST_SUITE_P(Sizes, SizeTest, ::testing::Values(1, 2, 7, 64, 130));

TEST_P(SizeTest, CholeskySolvesFromTheLowerTriangleAlone) {
  const Index n = GetParam();
  const MatrixXd root = Random(n, n + 3, 1), a = root * root.transpose(), x = Random(n, 3, 2);
  MatrixXd lower = a.triangularView<Eigen::Lower>();
  lower.triangularView<Eigen::StrictlyUpper>().setConstant(std::nan(""));
  const Cholesky factor(lower);
  ASSERT_TRUE(factor.ok());
  EXPECT_LT(Difference(factor.Solve(MatrixXd(a * x)), x), 1e-8);
  EXPECT_LT(Difference(factor.Solve(VectorXd(a * x.col(0))), x.col(0)), 1e-8);
  EXPECT_LT(Difference(factor.Inverse() * a, MatrixXd::Identity(n, n)), 1e-8);
}

TEST_P(SizeTest, ASymmetricMatrixIsItsEigenvectorsAndEigenvalues) {
  const Index n = GetParam();
  const MatrixXd half = Random(n, n, 3), a = half + half.transpose();
  const SymmetricEigen eigen = DecomposeSymmetric(a);
  EXPECT_LT(Difference(eigen.vectors * eigen.values.asDiagonal() * eigen.vectors.transpose(), a), 1e-11);
  EXPECT_LT(Difference(eigen.vectors.transpose() * eigen.vectors, MatrixXd::Identity(n, n)), 1e-12);
  EXPECT_TRUE(std::is_sorted(eigen.values.begin(), eigen.values.end()));
}

TEST_P(SizeTest, SingularValuesRebuildMatricesOfAnyShape) {
  const Index n = GetParam();
  for (const Index other : {n, n + 4, 2 * n}) {
    for (const MatrixXd& a : {Random(n, other, 4), Random(other, n, 5)}) {
      const SingularValues svd = DecomposeSingularValues(a);
      EXPECT_EQ(svd.values.size(), n);
      EXPECT_LT(Difference(svd.u * svd.values.asDiagonal() * svd.v.transpose(), a), 1e-11);
      EXPECT_LT(Difference(svd.u.transpose() * svd.u, MatrixXd::Identity(n, n)), 1e-12);
      EXPECT_LT(Difference(svd.v.transpose() * svd.v, MatrixXd::Identity(n, n)), 1e-12);
      EXPECT_GE(svd.values[n - 1], 0);
    }
  }
}

TEST_P(SizeTest, EigenvaluesHaveTheTraceAndMakeTheMatrixSingular) {
  const Index n = GetParam();
  const MatrixXd a = Random(n, n, 6);
  const Eigen::VectorXcd values = Eigenvalues(a);
  EXPECT_NEAR(std::abs(values.sum() - a.trace()), 0, 1e-11);
  for (const std::complex<double>& value : values) {
    const Eigen::MatrixXcd shifted = a.cast<std::complex<double>>() - value * Eigen::MatrixXcd::Identity(n, n);
    EXPECT_FALSE(Eigen::FullPivLU<Eigen::MatrixXcd>(shifted).setThreshold(1e-10).isInvertible());
  }
}

TEST_P(SizeTest, TheResidualOfLeastSquaresIsOrthogonalToTheColumns) {
  const Index n = GetParam();
  const MatrixXd a = Random(3 * n, n, 7), b = Random(3 * n, 2, 8);
  const MatrixXd x = SolveLeastSquares(a, b);
  ASSERT_EQ(x.rows(), n);
  EXPECT_LT(Difference(a.transpose() * (a * x - b), MatrixXd::Zero(n, 2)), 1e-11);
}

TEST(BlasTest, StaysInOneThread) {
  ASSERT_TRUE(Cholesky(MatrixXd::Identity(2, 2)).ok());
  EXPECT_EQ(openblas_get_num_threads(), 1);
}

TEST(CholeskyTest, RefusesWhatIsNotPositiveDefinite) {
  MatrixXd a = MatrixXd::Identity(4, 4);
  a(2, 2) = -1;
  EXPECT_FALSE(Cholesky(a).ok());
  a(2, 2) = std::nan("");
  EXPECT_FALSE(Cholesky(a).ok());
}

TEST(DecompositionsTest, WhatHasNoDecompositionHasNoValues) {
  const MatrixXd a = MatrixXd::Constant(5, 5, std::numeric_limits<double>::quiet_NaN());
  EXPECT_TRUE(DecomposeSingularValues(a).values.array().isNaN().all());
  EXPECT_TRUE(DecomposeSymmetric(a).values.array().isNaN().all());
  EXPECT_TRUE(Eigenvalues(a).real().array().isNaN().all());
}

TEST(LeastSquaresTest, OfAllSolutionsTheShortestIsTaken) {
  const MatrixXd wide = Random(3, 5, 9), b = Random(3, 1, 10);
  const MatrixXd x = SolveLeastSquares(wide, b);
  EXPECT_LT(Difference(wide * x, b), 1e-12);
  EXPECT_LT(Difference(x, wide.transpose() * (wide * wide.transpose()).inverse() * b), 1e-12);
  MatrixXd twice(4, 2);  // the same column twice shares its factor
  twice << 1, 1, 2, 2, 3, 3, 4, 4;
  const MatrixXd shared = SolveLeastSquares(twice, twice.col(0));
  EXPECT_LT(Difference(shared, MatrixXd::Constant(2, 1, 0.5)), 1e-12);
}

TEST(LeastSquaresTest, NothingInIsNothingOut) {
  EXPECT_TRUE(SolveLeastSquares(MatrixXd::Zero(4, 2), MatrixXd::Ones(4, 1)).isZero());
}

}  // namespace
}  // namespace metaekf::linalg
