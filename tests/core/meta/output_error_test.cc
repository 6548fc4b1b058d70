#include "core/meta/output_error.h"

#include <gtest/gtest.h>

#include "core/base/rng.h"
#include "core/meta/arx.h"

namespace metaekf::meta {
namespace {

/// y_t = ŷ_t + noise, ŷ_t = 0.1 + 1.6 ŷ_{t−1} − 0.8 ŷ_{t−2} + 0.02 u_t + 0.01 u_{t−1} − 0.3 w_{t−1}: an output-error model of
/// order 2 with inputs u (100) and w (1). Poles 0.8 ± 0.4i.
data::Trajectory Recording(int64_t length, double noise, uint64_t seed = 1) {
  base::Rng rng(seed);
  data::Trajectory t;
  t.inputs.resize(2, length);
  Eigen::VectorXd clean = Eigen::VectorXd::Zero(length);
  for (Eigen::Index k = 0; k < length; ++k) {
    t.inputs.col(k) << 100 * rng.Normal(), rng.Normal();
    if (k >= 2) {
      clean[k] = 0.1 + 1.6 * clean[k - 1] - 0.8 * clean[k - 2] + 0.02 * t.inputs(0, k) + 0.01 * t.inputs(0, k - 1) -
                 0.3 * t.inputs(1, k - 1);
    }
  }
  t.outputs = clean.transpose();
  for (Eigen::Index k = 0; k < length; ++k) t.outputs(0, k) += noise * rng.Normal();
  t.states.resize(0, length);
  return t;
}

double RootMeanSquare(const Eigen::MatrixXd& values) { return std::sqrt(values.array().square().mean()); }

TEST(OutputErrorTest, FindsALinearSystemExactly) {
  const data::Trajectory recording = Recording(200, 0), other = Recording(200, 0, 2);
  const absl::StatusOr<OutputErrorModel> model = OutputErrorModel::Fit(recording, 2);
  ASSERT_TRUE(model.ok()) << model.status();
  for (const data::Trajectory& trajectory : {recording, other}) {
    const Eigen::MatrixXd prediction = model->Predict(trajectory, true, 0);
    EXPECT_TRUE(std::isnan(prediction(0, 1)));
    EXPECT_LT((prediction - trajectory.outputs).rightCols(198).norm(), 1e-8 * trajectory.outputs.norm());
  }
}

TEST(OutputErrorTest, FindsASystemBehindNoiseWhereArxDoesNot) {
  // Deviation of the response: about 6. With noise of 1, the free-run error of the estimate is about 1 · √(9 / 4000) = 0.05.
  const data::Trajectory recording = Recording(4000, 1), clean = Recording(2000, 0, 2);
  const absl::StatusOr<OutputErrorModel> model = OutputErrorModel::Fit(recording, 2);
  const absl::StatusOr<ArxModel> arx = ArxModel::Fit(recording, 2);
  ASSERT_TRUE(model.ok()) << model.status();
  const auto error = [&clean](const auto& fitted) {
    return RootMeanSquare((fitted->Predict(clean, true, 50) - clean.outputs).rightCols(1950));
  };
  EXPECT_LT(error(model), 0.15);
  EXPECT_GT(error(arx), 3 * error(model));
}

TEST(OutputErrorTest, EveryOutputHasAModelOfItsOwn) {
  data::Trajectory both = Recording(300, 0);
  both.outputs.conservativeResize(2, Eigen::NoChange);
  both.outputs.row(1) = 1e-6 * Recording(300, 0).outputs.row(0).array() + 1e-7;  // other units
  const absl::StatusOr<OutputErrorModel> model = OutputErrorModel::Fit(both, 2);
  ASSERT_TRUE(model.ok()) << model.status();
  const Eigen::MatrixXd error = (model->Predict(both, true, 0) - both.outputs).rightCols(298);
  EXPECT_LT(error.row(1).norm(), 1e-8 * both.outputs.row(1).norm());
}

TEST(OutputErrorTest, AnUnstableStartBecomesAStableModel) {
  // An oscillation that grows: ARX finds poles outside the circle, with which a long free run would overflow.
  data::Trajectory growing;
  growing.inputs.resize(0, 100);
  growing.states.resize(0, 100);
  growing.outputs.resize(1, 100);
  for (Eigen::Index k = 0; k < 100; ++k) growing.outputs(0, k) = std::pow(1.02, static_cast<double>(k)) * std::cos(0.3 * static_cast<double>(k));
  const absl::StatusOr<OutputErrorModel> model = OutputErrorModel::Fit(growing, 2);
  ASSERT_TRUE(model.ok()) << model.status();
  EXPECT_TRUE(model->Predict(growing, true, 0).rightCols(98).allFinite());
}

TEST(OutputErrorTest, OneStepAheadIsFreeRun) {
  const data::Trajectory recording = Recording(100, 0.5);
  const absl::StatusOr<OutputErrorModel> model = OutputErrorModel::Fit(recording, 2);
  ASSERT_TRUE(model.ok()) << model.status();
  EXPECT_EQ(model->Predict(recording, false, 10).rightCols(90), model->Predict(recording, true, 10).rightCols(90));
}

TEST(OutputErrorTest, MistakesAreRefused) {
  EXPECT_EQ(OutputErrorModel::Fit(Recording(12, 0), 2).status().code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_TRUE(OutputErrorModel::Fit(Recording(13, 0), 2).ok());
  EXPECT_EQ(OutputErrorModel::Fit(Recording(60, 0), 0).status().code(), absl::StatusCode::kInvalidArgument);
  data::Trajectory gap = Recording(60, 0);
  gap.outputs(0, 30) = std::nan("");
  EXPECT_EQ(OutputErrorModel::Fit(gap, 2).status().code(), absl::StatusCode::kInvalidArgument);
}

}  // namespace
}  // namespace metaekf::meta
