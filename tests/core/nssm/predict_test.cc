#include "core/nssm/predict.h"

#include <gtest/gtest.h>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "core/base/rng.h"
#include "core/filter/filter_model.h"
#include "tests/core/nssm/random_models.h"
#include "tests/support/bundles.h"

namespace metaekf::nssm {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

Bundle SomeBundle(const ModelCase& c) {
  data::Normaliser normaliser = support::UnitBundle(*Model::Create(c.model)).normaliser;
  normaliser.outputs.mean.setConstant(0.3);
  normaliser.outputs.scale.setConstant(2);
  ModelSpec spec = c.model;
  TakeUnits(normaliser, &spec);
  Bundle bundle = support::UnitBundle(*Model::Create(spec));
  bundle.normaliser = normaliser;
  bundle.parameters = RandomParameters(bundle.model, 3);
  for (double& value : bundle.parameters) value *= 0.5;  // so that free runs stay bounded
  return bundle;
}

VectorXd Window(const data::Trajectory& t, Index end, Index length, const data::Normaliser& n) {
  const MatrixXd y = n.outputs.Normalise(t.outputs);
  VectorXd window(length * (t.inputs.rows() + y.rows()));
  for (Index s = 0, at = 0; s < length; ++s) {
    for (const MatrixXd* m : {&t.inputs, &y}) {
      window.segment(at, m->rows()) = m->col(end - length + 1 + s);
      at += m->rows();
    }
  }
  return window;
}

TEST(PredictTest, TheIncrementScaleIsAFactorOnTheTransitionsLastLayers) {
  for (ModelCase c : ModelCases()) {
    SCOPED_TRACE(c.name);
    const data::Trajectory t = RandomTrajectory(c.model, 15, 2);
    c.model.transition.increment_scale = 0.25;
    const Bundle scaled = SomeBundle(c);
    Bundle plain = scaled;
    ModelSpec unscaled = scaled.model.spec();
    unscaled.transition.increment_scale = 1;
    plain.model = *Model::Create(unscaled);
    for (const auto& [block, spec] : {std::pair("transition.", c.model.transition.block),
                                      std::pair("transition_input.", c.model.transition.input_block)}) {
      const std::string last = absl::StrCat(block, spec.hidden_widths.size(), ".");
      for (const nn::Tensor& tensor : plain.model.layout().tensors()) {
        if (!absl::StartsWith(tensor.name, last)) continue;
        for (int64_t i = 0; i < tensor.size(); ++i) plain.parameters[static_cast<size_t>(tensor.offset + i)] *= 0.25;
      }
    }
    const absl::StatusOr<Prediction> a = Predict(scaled, t, PredictionMode::kSimulate), b = Predict(plain, t, PredictionMode::kSimulate);
    ASSERT_TRUE(a.ok() && b.ok());
    const Index warmup = c.model.warmup(), judged = t.length() - warmup;
    EXPECT_LT((a->outputs - b->outputs).rightCols(judged).norm(), 1e-11 * b->outputs.rightCols(judged).norm());
  }
}

// Oracle: the filter's f and h called step by step, a code path without scans or batches.
TEST(PredictTest, BothModesEqualTheStepFunctions) {
  for (const ModelCase& c : ModelCases()) {
    SCOPED_TRACE(c.name);
    const Bundle bundle = SomeBundle(c);
    const data::Trajectory t = RandomTrajectory(c.model, 15, 2);
    const auto fm = filter::FilterModel::Create(bundle);
    const auto parameters = fm->Prepare(bundle.parameters);
    const auto scratch = fm->MakeScratch();
    const Index n = fm->state_size(), n_y = c.model.output_size, warmup = c.model.warmup();
    VectorXd f(n), h(n_y), state(n);
    MatrixXd F(n, n), H(n_y, n);
    const Index shift = c.model.transition.input_time == InputTime::kNext ? 0 : -1;
    for (const PredictionMode mode : {PredictionMode::kOneStep, PredictionMode::kSimulate}) {
      const absl::StatusOr<Prediction> prediction = Predict(bundle, t, mode);
      ASSERT_TRUE(prediction.ok()) << prediction.status();
      for (Index k = 0; k < warmup; ++k) EXPECT_TRUE(std::isnan(prediction->outputs(0, k)));
      for (Index k = warmup; k < t.length(); ++k) {
        if (k == warmup || mode == PredictionMode::kOneStep) {
          if (c.model.is_case_one()) {
            fm->Encode(*parameters, Window(t, k - 1, warmup, bundle.normaliser), &state, scratch.get());
          } else {
            state = t.states.col(k - 1);
          }
        }
        fm->Transition(*parameters, state, t.inputs.col(k + (c.model.is_case_one() ? shift : -1)), &f, &F, scratch.get());
        state = f;
        fm->Measurement(*parameters, state, t.inputs.col(k), &h, &H, scratch.get());
        const VectorXd y = 2 * h + VectorXd::Constant(n_y, 0.3);
        EXPECT_LT((prediction->outputs.col(k) - y).norm(), 1e-11 * (1 + y.norm())) << "sample " << k;
        if (c.model.is_case_one()) continue;
        EXPECT_LT((prediction->states.col(k) - state).norm(), 1e-11 * (1 + state.norm()));
      }
    }
  }
}

// Weights of any size, in float and double, one step ahead and in free run.
TEST(PredictTest, WhatIsConstrainedIsInsideWhateverTheWeights) {
  int64_t checked = 0;
  for (uint64_t seed = 0; seed < 240; ++seed) {
    for (ModelCase c : ModelCases()) {
      if (c.model.state_set.empty() && c.model.output_set.empty()) continue;
      if (seed % 2 == 0) c.model.precision = Precision::kFloat32;
      Bundle bundle = SomeBundle(c);
      base::Rng rng(seed);
      const double size = std::pow(10.0, rng.Uniform(-3, 4));
      for (double& parameter : bundle.parameters) parameter = size * rng.Normal();
      RoundToPrecision(c.model.precision, &bundle.parameters);
      const data::Trajectory t = RandomTrajectory(c.model, 1000, seed);
      for (const PredictionMode mode : {PredictionMode::kOneStep, PredictionMode::kSimulate}) {
        const Prediction prediction = *Predict(bundle, t, mode);
        for (const auto& [set, values] : {std::pair{bundle.model.output_set(), &prediction.outputs}, {bundle.model.state_set(), &prediction.states}}) {
          for (Index k = c.model.warmup(); set != nullptr && k < values->cols(); ++k) {
            if (!values->col(k).allFinite()) continue;  // a free run that has left the numbers
            ASSERT_TRUE(physics::Contains(*set, values->col(k))) << c.name << ", seed " << seed << ", sample " << k;
            ++checked;
          }
        }
      }
    }
  }
  EXPECT_GT(checked, 1000000);
}

TEST(PredictTest, LongRecordingsAreCutIntoChunksWithoutASeam) {
  const ModelCase c = ModelCases().front();
  const Bundle bundle = SomeBundle(c);
  const data::Trajectory t = RandomTrajectory(c.model, 9000, 2);
  data::Trajectory head = t;
  head.inputs = t.inputs.leftCols(5000);
  head.outputs = t.outputs.leftCols(5000);
  head.states.resize(0, 5000);
  for (const PredictionMode mode : {PredictionMode::kOneStep, PredictionMode::kSimulate}) {
    const MatrixXd whole = Predict(bundle, t, mode)->outputs, part = Predict(bundle, head, mode)->outputs;
    EXPECT_LT((whole.middleCols(2, 4998) - part.middleCols(2, 4998)).norm(), 1e-10);
  }
}

TEST(PredictTest, ACurlFreeFieldIsCurlFreeInPhysicalUnits) {
  for (const ModelCase& c : ModelCases()) {
    if (!c.model.is_curl_free()) continue;
    Bundle bundle = SomeBundle(c);
    // One scale for the outputs, one for the positions, as the normaliser's groups give.
    bundle.normaliser.states.scale.setConstant(5);
    bundle.normaliser.states.mean = VectorXd::LinSpaced(2, 1, 2);
    const auto field = [&](double p0, double p1) {
      // ŷ_1 = h(x̂_1, u_1) would need f; h alone is a one-step prediction's output at a fixed x̂: use the filter's h.
      const auto fm = filter::FilterModel::Create(bundle);
      VectorXd h(2), x{{(p0 - 1) / 5, (p1 - 2) / 5}};
      MatrixXd H(2, 2);
      fm->Measurement(*fm->Prepare(bundle.parameters), x, VectorXd::Constant(1, 0.4), &h, &H, fm->MakeScratch().get());
      return VectorXd(2 * h);
    };
    // Positions are states 1 and 0: component 0 belongs to p1, component 1 to p0. Central differences.
    const double step = 1e-4;
    const double d0 = (field(0.3 + step, 0.7)[0] - field(0.3 - step, 0.7)[0]) / (2 * step);
    const double d1 = (field(0.3, 0.7 + step)[1] - field(0.3, 0.7 - step)[1]) / (2 * step);
    EXPECT_NEAR(d0, d1, 1e-7 * (std::fabs(d0) + std::fabs(d1))) << c.name;
    EXPECT_GT(std::fabs(d0), 1e-6);
  }
}

TEST(PredictTest, WrongChannelsAndShortRecordingsAreRefused) {
  const ModelCase c = ModelCases().front();
  const Bundle bundle = SomeBundle(c);
  data::Trajectory t = RandomTrajectory(c.model, 2, 2);
  EXPECT_EQ(Predict(bundle, t, PredictionMode::kSimulate).status().code(), absl::StatusCode::kFailedPrecondition);
  t = RandomTrajectory(c.model, 20, 2);
  t.inputs.resize(2, 20);
  EXPECT_EQ(Predict(bundle, t, PredictionMode::kSimulate).status().code(), absl::StatusCode::kInvalidArgument);
}

// By hand: errors 1, −1 and 2 against deviations −1, 0, 1 from the mean 2; the NaN pair does not count.
TEST(PredictTest, ScoresMatchAHandComputation) {
  const double nan = std::nan("");
  const Score score = ScorePredictions({MatrixXd{{1, 2}}, MatrixXd{{3, 9}}}, {MatrixXd{{0, 3}}, MatrixXd{{1, nan}}});
  EXPECT_EQ(score.samples, 3);
  EXPECT_DOUBLE_EQ(score.rmse[0], std::sqrt(6.0 / 3));
  EXPECT_DOUBLE_EQ(score.fit_percent[0], 100 * (1 - std::sqrt(6.0 / 2)));
}

}  // namespace
}  // namespace metaekf::nssm
