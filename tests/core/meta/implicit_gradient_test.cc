#include "core/meta/implicit_gradient.h"

#include <gtest/gtest.h>

#include <Eigen/LU>

namespace metaekf::meta {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Three parameters that adapt, two that do not.
class ImplicitGradientTest : public ::testing::Test {
 protected:
  ImplicitGradientTest() {
    layout_.Add("adapted", 3, 1);
    layout_.Add("frozen", 2, 1);
    MatrixXd root(5, 5);
    root << 2, 1, 0, 1, 0, 0, 1, 1, 0, 2, 1, 0, 3, 1, 1, 0, 1, 0, 1, 1, 1, 0, 0, 0, 2;
    hessian_ = root * root.transpose() / 5;
    t_ = (VectorXd(5) << 1, -2, 0.5, 3, -1).finished();
  }
  VectorXd Apply(double lambda, const ImplicitMamlSpec& solver) {
    const ImplicitGradient<double> implicit(layout_, {true, false}, lambda, solver);
    ImplicitGradient<double>::Scratch scratch(implicit);
    VectorXd gradient = t_;
    const auto hessian_vector = [this](const double* v, double* product) {
      ++products_;
      EXPECT_EQ(v[3], 0);
      EXPECT_EQ(v[4], 0);
      Eigen::Map<VectorXd>(product, 5) = hessian_ * Eigen::Map<const VectorXd>(v, 5);
    };
    implicit.Apply(hessian_vector, gradient.data(), &scratch);
    return gradient;
  }

  nn::ParameterLayout layout_;
  MatrixXd hessian_;
  VectorXd t_;
  int products_ = 0;
};

TEST_F(ImplicitGradientTest, IsTheSolutionAndItsCrossTerm) {
  const double lambda = 0.3;
  VectorXd expected(5);
  expected.head(3) = (MatrixXd::Identity(3, 3) + hessian_.topLeftCorner(3, 3) / lambda).inverse() * t_.head(3);
  expected.tail(2) = t_.tail(2) - hessian_.bottomLeftCorner(2, 3) * expected.head(3) / lambda;
  EXPECT_LT((Apply(lambda, {.cg_steps = 3, .cg_tolerance = 0}) - expected).norm(), 1e-12);
}

TEST_F(ImplicitGradientTest, StopsAtTheTolerance) {
  Apply(0.3, {.cg_steps = 100, .cg_tolerance = 1e-8});
  EXPECT_LE(products_, 5);  // three dimensions, and the cross term
  products_ = 0;
  Apply(0.3, {.cg_steps = 1, .cg_tolerance = 0});
  EXPECT_EQ(products_, 2);
}

TEST_F(ImplicitGradientTest, AnInfinitePullLeavesTheGradient) {
  EXPECT_LT((Apply(1e14, {}) - t_).norm(), 1e-12);
}

TEST_F(ImplicitGradientTest, NegativeCurvatureAtOnceLeavesTheFirstOrderGradient) {
  hessian_ = -2 * MatrixXd::Identity(5, 5);
  EXPECT_EQ(Apply(1, {}), t_);
}

// A = diag(2, 2, −1): the first direction (1, 1, 1) has positive curvature, a later one has not.
TEST_F(ImplicitGradientTest, NegativeCurvatureLaterKeepsWhatIsSolved) {
  hessian_.setZero();
  hessian_.diagonal() << 1, 1, -2, 0, 0;
  t_ << 1, 1, 1, 0, 0;
  const VectorXd gradient = Apply(1, {.cg_steps = 50, .cg_tolerance = 0});
  EXPECT_TRUE(gradient.allFinite());
  EXPECT_LT((gradient - t_).norm(), 1e-12);  // one step of length |t|²/tᵀAt = 1
}

}  // namespace
}  // namespace metaekf::meta
