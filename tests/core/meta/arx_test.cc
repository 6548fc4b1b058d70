#include "core/meta/arx.h"

#include <gtest/gtest.h>

#include "core/base/rng.h"

namespace metaekf::meta {
namespace {

/// y_t = 1 + 1.2 y_{t−1} − 0.5 y_{t−2} + 0.3 u_t + 0.7 u_{t−1}: an ARX(2) model without noise.
data::Trajectory Recording(int64_t length) {
  base::Rng rng(1);
  data::Trajectory t;
  t.inputs.resize(1, length);
  t.outputs = Eigen::MatrixXd::Zero(1, length);
  t.states.resize(0, length);
  for (Eigen::Index k = 0; k < length; ++k) {
    t.inputs(0, k) = 100 * rng.Normal();
    if (k >= 2) {
      t.outputs(0, k) = 1 + 1.2 * t.outputs(0, k - 1) - 0.5 * t.outputs(0, k - 2) + 0.3 * t.inputs(0, k) + 0.7 * t.inputs(0, k - 1);
    }
  }
  return t;
}

TEST(ArxTest, FindsALinearSystemExactly) {
  const data::Trajectory recording = Recording(60);
  for (const int order : {2, 3}) {  // with a superfluous order, too
    const absl::StatusOr<ArxModel> arx = ArxModel::Fit(recording, order);
    ASSERT_TRUE(arx.ok()) << arx.status();
    for (const bool simulate : {false, true}) {
      const Eigen::MatrixXd prediction = arx->Predict(recording, simulate, 0);
      for (Eigen::Index t = 0; t < order; ++t) EXPECT_TRUE(std::isnan(prediction(0, t)));
      EXPECT_LT((prediction - recording.outputs).rightCols(60 - order).norm(), 1e-8 * recording.outputs.norm());
    }
  }
}

TEST(ArxTest, TooFewSamplesAndMissingValuesAreRefused) {
  EXPECT_EQ(ArxModel::Fit(Recording(7), 2).status().code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_TRUE(ArxModel::Fit(Recording(8), 2).ok());
  data::Trajectory gap = Recording(60);
  gap.outputs(0, 30) = std::nan("");
  EXPECT_EQ(ArxModel::Fit(gap, 2).status().code(), absl::StatusCode::kInvalidArgument);
}

}  // namespace
}  // namespace metaekf::meta
