#include "core/meta/levenberg_marquardt.h"

#include <gtest/gtest.h>

#include <Eigen/QR>
#include <cmath>
#include <limits>

namespace metaekf::meta {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Φ = ½ |r(x)|² from residuals and their Jacobian.
template <typename Residuals>
Objective LeastSquares(const Residuals& residuals) {
  return {.cost =
              [=](const VectorXd& x) {
                return 0.5 * residuals(x).first.squaredNorm();
              },
          .linearise =
              [=](const VectorXd& x, QuadraticModel* model) {
                const auto [r, jacobian] = residuals(x);
                *model = {0.5 * r.squaredNorm(), jacobian.transpose() * r, jacobian.transpose() * jacobian};
              }};
}

TEST(LevenbergMarquardtTest, SolvesALinearProblemExactly) {
  MatrixXd a(4, 2);
  a << 1, 2, 3, 4, 5, 6, 7, 9;
  const VectorXd b = VectorXd::LinSpaced(4, 1, -2);
  const Objective objective = LeastSquares([=](const VectorXd& x) { return std::pair<VectorXd, MatrixXd>(a * x - b, a); });
  const LevenbergMarquardtResult result =
      MinimiseLevenbergMarquardt(objective, VectorXd::Zero(2), {.max_iterations = 100, .tolerance = 1e-15}, nullptr);
  EXPECT_TRUE(result.converged);
  EXPECT_LT((result.x - a.colPivHouseholderQr().solve(b)).norm(), 1e-7);
}

TEST(LevenbergMarquardtTest, FindsTheFloorOfRosenbrocksValley) {
  const Objective objective = LeastSquares([](const VectorXd& x) {
    VectorXd r(2);
    r << 10 * (x[1] - x[0] * x[0]), 1 - x[0];
    MatrixXd jacobian(2, 2);
    jacobian << -20 * x[0], 10, -1, 0;
    return std::pair<VectorXd, MatrixXd>(r, jacobian);
  });
  const LevenbergMarquardtResult result =
      MinimiseLevenbergMarquardt(objective, Eigen::Vector2d(-1.2, 1), {.max_iterations = 100, .tolerance = 1e-14}, nullptr);
  EXPECT_LT((result.x - Eigen::Vector2d(1, 1)).norm(), 1e-6);
  EXPECT_LT(result.iterations, 40);
}

TEST(LevenbergMarquardtTest, FollowsANarrowCurvedValleyWhereTheResidualsSayHowTheyBend) {
  constexpr double kNarrow = 1e4;
  Objective objective = LeastSquares([=](const VectorXd& x) {
    VectorXd r(2);
    r << kNarrow * (x[1] - x[0] * x[0]), 1 - x[0];
    MatrixXd jacobian(2, 2);
    jacobian << -2 * kNarrow * x[0], kNarrow, -1, 0;
    return std::pair<VectorXd, MatrixXd>(r, jacobian);
  });
  const auto minimise = [&objective] {
    return MinimiseLevenbergMarquardt(objective, Eigen::Vector2d(-1.2, 1), {.max_iterations = 1000, .tolerance = 1e-14}, nullptr);
  };
  const LevenbergMarquardtResult straight = minimise();
  objective.bend = [=](const VectorXd& x, const VectorXd& direction, double) -> std::optional<VectorXd> {
    const double r = -2 * kNarrow * direction[0] * direction[0];  // of the first residual; the second one is straight
    return VectorXd(Eigen::Vector2d(-2 * kNarrow * x[0] * r, kNarrow * r));
  };
  const LevenbergMarquardtResult bent = minimise();
  for (const LevenbergMarquardtResult* result : {&straight, &bent}) {
    EXPECT_LT((result->x - Eigen::Vector2d(1, 1)).norm(), 1e-6);
  }
  EXPECT_LT(2 * bent.iterations, straight.iterations);
}

TEST(LevenbergMarquardtTest, NeverAcceptsWhatIsWorseOrNotANumber) {
  // √ is not defined where a full step from 4 would go.
  const Objective objective = LeastSquares([](const VectorXd& x) {
    const double root = x[0] < 0 ? std::numeric_limits<double>::quiet_NaN() : std::sqrt(x[0]);
    return std::pair<VectorXd, MatrixXd>(VectorXd::Constant(1, root), MatrixXd::Constant(1, 1, 0.5 / root));
  });
  double last = std::numeric_limits<double>::infinity();
  const LevenbergMarquardtResult result = MinimiseLevenbergMarquardt(
      objective, VectorXd::Constant(1, 4), {.max_iterations = 60, .tolerance = 1e-12}, [&](int, double cost, const VectorXd&) {
        EXPECT_LT(cost, last);
        last = cost;
        return true;
      });
  EXPECT_LT(result.x[0], 1e-6);
  EXPECT_GE(result.x[0], 0);
}

TEST(LevenbergMarquardtTest, StopsWhenAskedWithTheBestSoFar) {
  const Objective objective = LeastSquares([](const VectorXd& x) {
    return std::pair<VectorXd, MatrixXd>(x.array().exp().matrix(), MatrixXd(x.array().exp().matrix().asDiagonal()));
  });
  const LevenbergMarquardtResult result =
      MinimiseLevenbergMarquardt(objective, VectorXd::Zero(2), {}, [](int iteration, double, const VectorXd&) { return iteration < 3; });
  EXPECT_TRUE(result.stopped);
  EXPECT_EQ(result.iterations, 3);
  EXPECT_LT(result.model.cost, 1);
}

}  // namespace
}  // namespace metaekf::meta
