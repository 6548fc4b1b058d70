#include "core/filter/square_root.h"

#include <gtest/gtest.h>

#include <Eigen/LU>

#include "core/base/rng.h"

namespace metaekf::filter {
namespace {

using Eigen::MatrixXd;

MatrixXd Random(base::Rng* rng, Eigen::Index rows, Eigen::Index cols) {
  MatrixXd m(rows, cols);
  for (Eigen::Index i = 0; i < m.size(); ++i) m.data()[i] = rng->Normal();
  return m;
}

TEST(SquareRootTest, TriangularisingKeepsTheProduct) {
  base::Rng rng(1);
  for (const auto& [m, n] : {std::pair{1, 1}, {2, 4}, {3, 3}, {3, 7}, {6, 12}, {40, 80}}) {
    MatrixXd a = Random(&rng, m, n);
    if (m == 3) a.row(1).setZero();  // rank deficient
    const MatrixXd product = a * a.transpose();
    LowerTriangularise(a);
    EXPECT_TRUE((a * a.transpose()).isApprox(product, 1e-13));
    for (Eigen::Index i = 0; i < m; ++i) {
      EXPECT_GE(a(i, i), 0);
      for (Eigen::Index j = i + 1; j < n; ++j) EXPECT_EQ(a(i, j), 0);
    }
  }
}

TEST(SquareRootTest, TriangularisingBearsWhatIsFarApart) {
  for (const double tail : {1e-300, 1e-150, 1e-20, 1e20, 1e150}) {
    for (const double head : {-1.0, 0.0, 1.0}) {
      MatrixXd a{{head, tail, -tail}, {1, 2, tail}};
      const Eigen::Matrix2d product = a * a.transpose();
      LowerTriangularise(a);
      EXPECT_TRUE(a.allFinite()) << head << " beside " << tail;
      const Eigen::Matrix2d now = a * a.transpose();
      for (Eigen::Index i = 0; i < 2; ++i) EXPECT_NEAR(now(i, i), product(i, i), 1e-13 * product(i, i) + 1e-280) << head << " beside " << tail;
    }
  }
}

TEST(SquareRootTest, SemidefiniteMatricesHaveFactors) {
  base::Rng rng(2);
  MatrixXd b = Random(&rng, 4, 2);
  const MatrixXd a = b * b.transpose();  // rank 2
  const absl::StatusOr<MatrixXd> l = SemidefiniteFactor(a);
  ASSERT_TRUE(l.ok()) << l.status();
  EXPECT_TRUE((*l * l->transpose()).isApprox(a, 1e-9));
  EXPECT_TRUE(SemidefiniteFactor(MatrixXd::Zero(3, 3))->isZero());
}

TEST(SquareRootTest, VariancesMayBeFarApart) {
  const MatrixXd a{{1e-12, 3e-5}, {3e-5, 1e4}};
  const absl::StatusOr<MatrixXd> l = SemidefiniteFactor(a);
  ASSERT_TRUE(l.ok()) << l.status();
  EXPECT_NEAR((*l)(0, 0), 1e-6, 1e-18);
  EXPECT_TRUE((*l * l->transpose()).isApprox(a, 1e-12));
  EXPECT_FALSE(SemidefiniteFactor(MatrixXd{{1e-12, 3e-3}, {3e-3, 1e4}}).ok());  // a correlation of 30
}

TEST(SquareRootTest, WhatIsNoCovarianceIsRefused) {
  MatrixXd indefinite(2, 2), asymmetric(2, 2), nan(1, 1);
  indefinite << 1, 2, 2, 1;
  asymmetric << 1, 0.5, 0, 1;
  nan << std::nan("");
  EXPECT_EQ(SemidefiniteFactor(indefinite).status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(SemidefiniteFactor(asymmetric).status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(SemidefiniteFactor(nan).status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(SemidefiniteFactor(MatrixXd::Zero(2, 3)).status().code(), absl::StatusCode::kInvalidArgument);
}

// Oracle: the textbook updates on P itself, the measurement update in Joseph's form.
TEST(SquareRootTest, UpdatesEqualTheJosephForm) {
  base::Rng rng(3);
  for (const auto& [n, m] : {std::pair{1, 1}, {3, 2}, {5, 5}}) {
    const MatrixXd root = Random(&rng, n, n), q_root = Random(&rng, n, n), r_root = Random(&rng, m, m);
    const MatrixXd F = Random(&rng, n, n), H = Random(&rng, m, n);
    const MatrixXd Q = q_root * q_root.transpose(), R = r_root * r_root.transpose();
    MatrixXd factor = *SemidefiniteFactor(root * root.transpose()), work(n, 2 * n);
    FactorTimeUpdate(F, *SemidefiniteFactor(Q), &work, &factor);
    const MatrixXd prior = F * root * root.transpose() * F.transpose() + Q;
    EXPECT_TRUE((factor * factor.transpose()).isApprox(prior, 1e-12));

    MatrixXd update(m + n, m + n);
    update.topLeftCorner(m, m) = *SemidefiniteFactor(R);
    FactorMeasurementUpdate(H, update, &factor);
    const MatrixXd S = H * prior * H.transpose() + R;
    const MatrixXd K = prior * H.transpose() * S.inverse();
    const MatrixXd I_KH = MatrixXd::Identity(n, n) - K * H;
    const MatrixXd posterior = I_KH * prior * I_KH.transpose() + K * R * K.transpose();
    EXPECT_TRUE((factor * factor.transpose()).isApprox(posterior, 1e-9));
    const MatrixXd s_root = update.topLeftCorner(m, m);
    EXPECT_TRUE((s_root * s_root.transpose()).isApprox(S, 1e-12));
    EXPECT_TRUE((update.bottomLeftCorner(n, m) * s_root.inverse()).isApprox(K, 1e-9));
  }
}

}  // namespace
}  // namespace metaekf::filter
