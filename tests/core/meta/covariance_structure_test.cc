#include "core/meta/covariance_structure.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

#include "core/base/numbers.h"
#include "core/base/rng.h"

namespace metaekf::meta {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

const nn::Pieces kTensors = {{0, 3}, {7, 2}, {20, 4}};  // somewhere in ω: only their sizes matter
constexpr Index kParameters = 9;

MatrixXd RandomMatrix(Index rows, Index cols, uint64_t seed) {
  base::Rng rng(seed);
  MatrixXd matrix(rows, cols);
  for (Index i = 0; i < matrix.size(); ++i) matrix.data()[i] = rng.Normal();
  return matrix;
}

/// Positive definite and of no structure.
MatrixXd SecondMoment(uint64_t seed) {
  const MatrixXd root = RandomMatrix(kParameters, 2 * kParameters, seed);
  return root * root.transpose() / kParameters;
}

GaussianPriorSpec Spec(PriorCovariance covariance, int32_t rank = 0) { return {.covariance = covariance, .rank = rank}; }

/// −½ (log |Σ| + tr Σ⁻¹ C), written out.
double LogLikelihood(const MatrixXd& covariance, const MatrixXd& second_moment) {
  const Eigen::LLT<MatrixXd> factor(covariance);
  return -factor.matrixLLT().diagonal().array().log().sum() - 0.5 * factor.solve(second_moment).trace();
}

TEST(CovarianceStructureTest, AFullOneIsTheSecondMoment) {
  const MatrixXd c = SecondMoment(1);
  EXPECT_EQ(FitStructure(Spec(PriorCovariance::kFull), kTensors, c).covariance, c);
}

TEST(CovarianceStructureTest, BlocksKeepEachTensorAndNothingBetweenTwo) {
  const MatrixXd c = SecondMoment(2);
  const MatrixXd blocks = FitStructure(Spec(PriorCovariance::kBlock), kTensors, c).covariance;
  const auto tensor_of = [](Index i) { return i < 3 ? 0 : i < 5 ? 1 : 2; };
  for (Index i = 0; i < kParameters; ++i) {
    for (Index j = 0; j < kParameters; ++j) EXPECT_EQ(blocks(i, j), tensor_of(i) == tensor_of(j) ? c(i, j) : 0);
  }
}

TEST(CovarianceStructureTest, FactorsAndADiagonalAreRecovered) {
  for (const Index rank : {1, 2, 3}) {
    const MatrixXd v = RandomMatrix(kParameters, rank, 3);
    const VectorXd d = RandomMatrix(kParameters, 1, 4).cwiseAbs2() + VectorXd::Constant(kParameters, 0.1);
    MatrixXd c = v * v.transpose();
    c.diagonal() += d;
    // Parameters of very different sizes are no harder: likelihood and steps do not depend on their units.
    const VectorXd units = VectorXd::LinSpaced(kParameters, -3, 3).unaryExpr([](double e) { return std::pow(10, e); });
    const MatrixXd scaled = units.asDiagonal() * c * units.asDiagonal();
    const FactorModel model = FitFactors(scaled, rank, {.max_iterations = 2000, .tolerance = 1e-11});
    const VectorXd back = units.cwiseInverse();
    const MatrixXd found = back.asDiagonal() * model.Covariance() * back.asDiagonal();
    const double error = (found - c).norm() / c.norm();
    EXPECT_LT(error, 1e-6) << "rank " << rank;
    EXPECT_LT((back.cwiseAbs2().cwiseProduct(model.diagonal) - d).norm(), 1e-6 * d.norm()) << "rank " << rank;
    RecordProperty("error_of_rank_" + std::to_string(rank), base::FormatShort(error));
    RecordProperty("iterations_of_rank_" + std::to_string(rank), std::to_string(model.log_likelihoods.size() - 1));
  }
}

// Of these some end at the floor of D, where θ reaches 1e6 and ℓ is known to 1e-10.
TEST(CovarianceStructureTest, TheLikelihoodNeverFallsAndIsThatOfTheModel) {
  double deepest = 0;
  for (uint64_t seed = 10; seed < 30; ++seed) {
    const MatrixXd c = SecondMoment(seed);
    for (const Index rank : {Index{1}, Index{4}, kParameters}) {
      const FactorModel model = FitFactors(c, rank);
      const std::vector<double>& trace = model.log_likelihoods;
      for (size_t i = 1; i < trace.size(); ++i) {
        EXPECT_GE(trace[i], trace[i - 1] - 1e-9) << "seed " << seed << ", rank " << rank << ", iteration " << i;
        deepest = std::max(deepest, trace[i - 1] - trace[i]);
      }
      EXPECT_NEAR(trace.back(), LogLikelihood(model.Covariance(), c), 1e-8);
    }
  }
  RecordProperty("deepest_fall", base::FormatShort(deepest));
}

// At a maximum no small change of V or D makes the likelihood larger; central differences, in every direction.
TEST(CovarianceStructureTest, TheFitIsAMaximum) {
  const MatrixXd v = RandomMatrix(kParameters, 2, 5);
  const MatrixXd c = v * v.transpose() + 0.3 * SecondMoment(5) + MatrixXd::Identity(kParameters, kParameters);
  const FactorModel best = FitFactors(c, 2, {.max_iterations = 2000, .tolerance = 1e-10});
  ASSERT_GT(best.diagonal.minCoeff(), 1e-3);  // the floor is not met, so the derivative has to be zero
  constexpr double kStep = 1e-5;
  const auto slope = [&](const auto& at) {
    FactorModel up = best, down = best;
    at(&up) += kStep;
    at(&down) -= kStep;
    return (LogLikelihood(up.Covariance(), c) - LogLikelihood(down.Covariance(), c)) / (2 * kStep);
  };
  for (Index i = 0; i < kParameters; ++i) {
    EXPECT_NEAR(slope([i](FactorModel* m) -> double& { return m->diagonal[i]; }), 0, 1e-7);
    for (Index k = 0; k < 2; ++k) {
      EXPECT_NEAR(slope([i, k](FactorModel* m) -> double& { return m->loadings(i, k); }), 0, 1e-7);
    }
  }
}

TEST(CovarianceStructureTest, ThePrecisionIsTheInverse) {
  const FactorModel model = FitFactors(SecondMoment(6), 3);
  EXPECT_LT((model.Precision() * model.Covariance() - MatrixXd::Identity(kParameters, kParameters)).norm(), 1e-8);
}

// C of rank one: the likelihood wants D at zero and has no maximum; the floor keeps Σ invertible.
TEST(CovarianceStructureTest, AVarianceThatVanishesStopsAtItsFloor) {
  const VectorXd v = RandomMatrix(kParameters, 1, 7);
  const FactorModel model = FitFactors(v * v.transpose(), 1);
  EXPECT_TRUE(model.Precision().allFinite());
  EXPECT_NEAR((model.diagonal.array() / v.array().square()).maxCoeff(), 1e-6, 1e-9);
  EXPECT_EQ(Eigen::LLT<MatrixXd>(model.Covariance()).info(), Eigen::Success);
}

TEST(CovarianceStructureTest, MoreFactorsThanParametersAreRefusedByName) {
  EXPECT_TRUE(CheckStructure(Spec(PriorCovariance::kLowRank, 9), 9).ok());
  const absl::Status status = CheckStructure(Spec(PriorCovariance::kLowRank, 10), 9);
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(status.message(), "gaussian_prior.rank: 10 is more than the 9 parameters that adapt");
}

}  // namespace
}  // namespace metaekf::meta
