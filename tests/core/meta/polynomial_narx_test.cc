#include "core/meta/polynomial_narx.h"

#include <gtest/gtest.h>

#include "core/base/rng.h"

namespace metaekf::meta {
namespace {

/// y_t = 0.5 y_{t−1} − 0.2 y_{t−1}² + 0.1 y_{t−1} u_{t−1}² + 0.3 u_t + noise.
data::Trajectory Recording(int64_t length, double noise, uint64_t seed = 1) {
  base::Rng rng(seed);
  data::Trajectory t;
  t.inputs.resize(1, length);
  t.outputs = Eigen::MatrixXd::Zero(1, length);
  t.states.resize(0, length);
  for (Eigen::Index k = 0; k < length; ++k) {
    t.inputs(0, k) = rng.Uniform(-1, 1);
    if (k == 0) continue;
    const double y = t.outputs(0, k - 1), u = t.inputs(0, k - 1);
    t.outputs(0, k) = 0.5 * y - 0.2 * y * y + 0.1 * y * u * u + 0.3 * t.inputs(0, k) + noise * rng.Normal();
  }
  return t;
}

TEST(PolynomialNarxTest, FindsAPolynomialSystemExactly) {
  const data::Trajectory other = Recording(100, 0, 2);
  for (const int order : {1, 2}) {  // with a superfluous order, too
    const absl::StatusOr<PolynomialNarxModel> model = PolynomialNarxModel::Fit(Recording(300, 0), order, 3);
    ASSERT_TRUE(model.ok()) << model.status();
    // (3 + 3)! / (3! 3!) and (5 + 3)! / (5! 3!).
    EXPECT_EQ(model->terms(), order == 1 ? 20 : 56);
    for (const bool simulate : {false, true}) {
      const Eigen::MatrixXd error = model->Predict(other, simulate, 0) - other.outputs;
      EXPECT_TRUE(std::isnan(error(0, order - 1)));
      EXPECT_LT(error.rightCols(100 - order).norm(), 1e-8 * other.outputs.norm());
    }
  }
}

TEST(PolynomialNarxTest, FindsVanDerPolExactly) {
  // Forward Euler, Δ = 0.01, θ = 1.5: of degree 3 in the states.
  data::Trajectory t;
  t.inputs.resize(0, 1000);
  t.states.resize(0, 1000);
  t.outputs.resize(2, 1000);
  t.outputs.col(0) << 1, -0.5;
  for (Eigen::Index k = 1; k < 1000; ++k) {
    const double x1 = t.outputs(0, k - 1), x2 = t.outputs(1, k - 1);
    t.outputs.col(k) << x1 + 0.01 * x2, x2 + 0.01 * (1.5 * x2 * (1 - x1 * x1) - x1);
  }
  data::Trajectory context = t;
  context.outputs = t.outputs.leftCols(400);
  context.inputs = t.inputs.leftCols(400);
  const absl::StatusOr<PolynomialNarxModel> model = PolynomialNarxModel::Fit(context, 1, 3);
  ASSERT_TRUE(model.ok()) << model.status();
  EXPECT_LT((model->Predict(t, true, 0) - t.outputs).rightCols(999).norm(), 1e-6 * t.outputs.norm());
}

TEST(PolynomialNarxTest, FindsASystemThroughNoise) {
  // 20 coefficients from 5,000 samples: a one-step error of σ √(20 / 5000) = 6e-4 on a clean recording.
  const absl::StatusOr<PolynomialNarxModel> model = PolynomialNarxModel::Fit(Recording(5000, 0.01), 1, 3);
  ASSERT_TRUE(model.ok()) << model.status();
  const data::Trajectory clean = Recording(2000, 0, 2);
  const Eigen::MatrixXd error = (model->Predict(clean, false, 0) - clean.outputs).rightCols(1999);
  EXPECT_LT(std::sqrt(error.array().square().mean()), 1.5e-3);
}

TEST(PolynomialNarxTest, AFreeRunThatDivergesIsInfiniteAndNoCrash) {
  const absl::StatusOr<PolynomialNarxModel> model = PolynomialNarxModel::Fit(Recording(300, 0), 1, 3);
  ASSERT_TRUE(model.ok()) << model.status();
  data::Trajectory far = Recording(50, 0);
  far.outputs(0, 0) = -40;  // −0.2 y² takes it ever further down
  const Eigen::MatrixXd prediction = model->Predict(far, true, 0);
  EXPECT_TRUE(std::isfinite(prediction(0, 1)));
  EXPECT_TRUE(std::isinf(prediction(0, 49)));
}

TEST(PolynomialNarxTest, MistakesAreRefused) {
  EXPECT_EQ(PolynomialNarxModel::Fit(Recording(20, 0), 1, 3).status().code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_TRUE(PolynomialNarxModel::Fit(Recording(21, 0), 1, 3).ok());
  for (const auto& [order, degree] : {std::pair(0, 1), {1, 0}, {20, 4}}) {
    EXPECT_EQ(PolynomialNarxModel::Fit(Recording(100, 0), order, degree).status().code(), absl::StatusCode::kInvalidArgument);
  }
  data::Trajectory gap = Recording(60, 0);
  gap.inputs(0, 30) = std::nan("");
  EXPECT_EQ(PolynomialNarxModel::Fit(gap, 1, 2).status().code(), absl::StatusCode::kInvalidArgument);
}

}  // namespace
}  // namespace metaekf::meta
