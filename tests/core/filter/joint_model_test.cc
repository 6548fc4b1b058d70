#include "core/filter/joint_model.h"

#include <gtest/gtest.h>

#include <Eigen/LU>

#include "core/filter/lasting_errors.h"
#include "tests/core/filter/linear_filter.h"
#include "tests/core/nssm/random_models.h"

namespace metaekf::filter {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

MatrixXd RandomMatrix(base::Rng* rng, Index rows, Index cols) {
  MatrixXd matrix(rows, cols);
  for (double& value : matrix.reshaped()) value = rng->Normal();
  return matrix;
}

// Of every kind of model, with unknown parameters and both biases, against central differences.
TEST(JointModelTest, JacobiansMatchDifferences) {
  for (const nssm::ModelCase& c : nssm::ModelCases()) {
    SCOPED_TRACE(c.name);
    const nssm::Model model = *nssm::Model::Create(c.model);
    const std::shared_ptr<const FilterModel> functions = FilterModel::Create(nssm::Bundle{.model = model});
    base::Rng rng(9);
    const Index n = functions->state_size(), n_y = c.model.output_size;
    const JointModel joint(functions, functions->Prepare(nssm::RandomParameters(model, 5), 0.1 * RandomMatrix(&rng, model.layout().size(), 3)),
                           {RandomMatrix(&rng, n, 2), 0.9}, {RandomMatrix(&rng, n_y, 1), 0.7});
    const Index all = joint.size();
    ASSERT_EQ(all, n + 3 + 2 + 1);
    const auto scratch = functions->MakeScratch();
    const VectorXd s = RandomVector(&rng, all), u = RandomVector(&rng, c.model.input_size);
    VectorXd f(all), h(n_y);
    MatrixXd F(all, all), H(n_y, all);
    F.setConstant(7);  // nothing of it is left
    H.setConstant(7);
    joint.Transition(s, u, &f, &F, scratch.get());
    joint.Measurement(s, u, &h, &H, scratch.get());
    const auto expect_derivative = [&](const MatrixXd& jacobian, const auto& value_at) {
      constexpr double kStep = 1e-6;
      for (Index j = 0; j < all; ++j) {
        const VectorXd step = kStep * VectorXd::Unit(all, j);
        const VectorXd up = value_at(s + step), down = value_at(s - step);
        EXPECT_LT((jacobian.col(j) - (up - down) / (2 * kStep)).norm(), 1e-7 * (1 + jacobian.norm())) << j;
      }
    };
    MatrixXd unused_F(all, all), unused_H(n_y, all);
    expect_derivative(F, [&](const VectorXd& at) {
      VectorXd value(all);
      joint.Transition(at, u, &value, &unused_F, scratch.get());
      return value;
    });
    expect_derivative(H, [&](const VectorXd& at) {
      VectorXd value(n_y);
      joint.Measurement(at, u, &value, &unused_H, scratch.get());
      return value;
    });
    // With nothing beside the state it is the model's own.
    VectorXd f_own(n), f_zero(all), zero = VectorXd::Zero(all);
    MatrixXd F_own(n, n);
    zero.head(n) = s.head(n);
    functions->Transition(*functions->Prepare(nssm::RandomParameters(model, 5)), s.head(n), u, &f_own, &F_own, scratch.get());
    joint.Transition(zero, u, &f_zero, &unused_F, scratch.get());
    EXPECT_EQ(f_own, f_zero.head(n));
    EXPECT_EQ(F_own, unused_F.topLeftCorner(n, n));
    if (c.model.is_case_one()) continue;
    VectorXd kept(all);
    MatrixXd J(all, all);
    J.setConstant(7);
    joint.Reconstruct(s, u, &kept, &J, scratch.get());
    EXPECT_EQ(kept.tail(all - n), s.tail(all - n));
    expect_derivative(J, [&](const VectorXd& at) {
      VectorXd value(all);
      joint.Reconstruct(at, u, &value, &unused_F, scratch.get());
      return value;
    });
  }
}

// Linear in [x; c]: there the filter is Kalman's.
TEST(JointModelTest, WithErrorsThatLastItIsTheKalmanFilterOfStateAndErrors) {
  const ErringSystem c;
  Filter filter(c.Known(), {.gate = {.probability = 0}});
  const Index n = 5;
  MatrixXd A = MatrixXd::Zero(n, n), C = MatrixXd::Zero(2, n), Q = MatrixXd::Zero(n, n), P = MatrixXd::Identity(n, n);
  A.topLeftCorner(2, 2) = c.system.A;
  A.block(0, 2, 2, 1) = c.of_f.loadings;
  A.diagonal().tail(3) << 0.95, 0.9, 0.9;
  C.leftCols(2) = c.system.C;
  C.rightCols(2) = c.of_h.loadings;
  Q.topLeftCorner(2, 2) = c.system.Q;
  Q.diagonal().tail(3) << 1 - 0.95 * 0.95, 1 - 0.9 * 0.9, 1 - 0.9 * 0.9;
  P.topLeftCorner(2, 2) = c.system.P0;
  VectorXd mean = VectorXd::Zero(n);
  const data::Trajectory run = c.Record(4, 300);
  for (Index t = 0; t < run.length(); ++t) {
    if (t > 0) {
      mean = A * mean;
      mean.head(2) += c.system.B * run.inputs(0, t - 1);
      P = A * P * A.transpose() + Q;
    }
    const MatrixXd K = P * C.transpose() * (C * P * C.transpose() + c.system.R).inverse();
    mean += K * (run.outputs.col(t) - C * mean);
    P = (MatrixXd::Identity(n, n) - K * C) * P;
    ASSERT_TRUE(filter.ekf.Step(run.inputs.col(t), run.outputs.col(t), filter.scratch.get(), &filter.estimate).ok());
    ASSERT_LT((filter.ekf.state().mean - mean).norm(), 1e-10 * (1 + mean.norm())) << t;
    ASSERT_LT((filter.estimate.cov - P.topLeftCorner(2, 2)).norm(), 1e-10) << t;
  }
}

// The user who says Q and R says what the errors are.
TEST(JointModelTest, GivenCovariancesTakeThePlaceOfErrorsThatLast) {
  const ErringSystem c;
  Filter given(c.Known(), {.process_cov = c.system.Q, .measurement_cov = c.system.R}), plain(LinearBundle(c.system));
  const data::Trajectory run = c.Record(4, 20);
  for (Index t = 0; t < run.length(); ++t) {
    for (Filter* filter : {&given, &plain}) {
      ASSERT_TRUE(filter->ekf.Step(run.inputs.col(t), run.outputs.col(t), filter->scratch.get(), &filter->estimate).ok());
    }
    ASSERT_EQ(given.estimate.mean, plain.estimate.mean);
    ASSERT_EQ(given.estimate.cov, plain.estimate.cov);
  }
}

TEST(LastingErrorsTest, SecondMomentsOfWhiteNoiseAndAnErrorThatLastsAreTakenApart) {
  const MatrixXd W{{0.5}, {-0.3}}, N{{0.2, 0.05}, {0.05, 0.1}};
  std::vector<MatrixXd> moments;
  for (int k = 0; k <= 20; ++k) moments.push_back(std::pow(0.9, k) * W * W.transpose());
  moments[0] += N;
  const SplitErrors split = SplitByDuration(moments);
  ASSERT_EQ(split.lasting.loadings.cols(), 1);
  EXPECT_NEAR(split.lasting.correlation, 0.9, 0.01);  // time constants are tried in steps of 5 %
  EXPECT_LT((split.lasting.loadings * split.lasting.loadings.transpose() - W * W.transpose()).norm(), 0.02 * W.squaredNorm());
  EXPECT_LT((split.white + split.lasting.loadings * split.lasting.loadings.transpose() - moments[0]).norm(), 1e-12);
}

TEST(LastingErrorsTest, WhatDoesNotLastIsWhite) {
  std::vector<MatrixXd> moments(21, MatrixXd(MatrixXd::Zero(2, 2)));
  moments[0] = MatrixXd{{2, 1}, {1, 3}};
  EXPECT_EQ(SplitByDuration(moments).lasting.loadings.cols(), 0);
  moments[1] = -0.4 * moments[0];  // as measurement noise in recorded states makes it
  const SplitErrors split = SplitByDuration(moments);
  EXPECT_EQ(split.lasting.loadings.cols(), 0);
  EXPECT_EQ(split.white, moments[0]);
}

// An error that hardly anything is beside leaves a definite covariance of the rest.
TEST(LastingErrorsTest, TheRestIsPositiveDefinite) {
  base::Rng rng(3);
  for (int trial = 0; trial < 200; ++trial) {
    const MatrixXd root = RandomMatrix(&rng, 4, 4);
    std::vector<MatrixXd> moments = {root * root.transpose() + 1e-6 * MatrixXd::Identity(4, 4)};
    for (int k = 1; k <= 20; ++k) moments.push_back(std::pow(0.97, k) * moments[0] + 0.3 * RandomMatrix(&rng, 4, 4));
    const SplitErrors split = SplitByDuration(moments);
    EXPECT_GT(split.white.llt().rcond(), 0);
    EXPECT_EQ(split.white.llt().info(), Eigen::Success);
    EXPECT_GE(split.lasting.correlation, 0);
    EXPECT_LT(split.lasting.correlation, 1);
  }
}

}  // namespace
}  // namespace metaekf::filter
