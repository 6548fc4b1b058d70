#include "core/meta/adapt.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/data/split.h"
#include "tests/core/meta/small_training.h"
#include "core/meta/train.h"

namespace metaekf::meta {
namespace {

using data::Dataset;
using data::Trajectory;

// A network of hundreds of parameters learns the noise of 40 samples by heart, if it is let: from scratch it stops where it
// simulates the tail best, and the whole context gets as many steps.
TEST(AdaptTest, GradientStepsFromScratchStopWhereTheTailIsSimulatedBest) {
  TrainingSpec spec = SmallSpec();
  spec.model.transition.block.hidden_widths = {40};
  const nssm::Bundle bundle = *Train(spec, Fleet(10, 80, 1), nullptr, base::CallingThread(), nullptr);
  Trajectory system = Fleet(1, 40, 3).trajectories[0];
  base::Rng rng(1);
  for (Eigen::Index t = 0; t < system.length(); ++t) system.states(0, t) += 0.3 * rng.Normal();
  system.outputs = system.states;
  const AdaptationOptions options{.method = AdaptationMethod::kFromScratch, .inner_loop = {.steps = 3000, .learning_rate = 3e-3}, .seed = 1};
  const AdaptationResult stopped = *Adapt(bundle, system, options, nullptr);
  EXPECT_LT(stopped.steps, options.inner_loop.steps);
  EXPECT_GT(stopped.steps, 0);
  AdaptationOptions as_many = options;
  as_many.inner_loop.steps = stopped.steps;
  EXPECT_EQ(AdaptedBundle(bundle, system, as_many)->parameters, stopped.parameters);
  // The end of the trial is no better on the tail than where it stopped: it is the trial of so many steps that tells its errors.
  nssm::Bundle to_the_end = bundle;
  to_the_end.parameters = AdaptedBundle(bundle, *data::FirstSamples(system, system.length() - stopped.tail_samples), options)->parameters;
  const Trajectory tail = *data::SamplesFrom(system, system.length() - stopped.tail_samples);
  const auto simulated = nssm::Predict(to_the_end, tail, nssm::PredictionMode::kSimulate);
  EXPECT_GT(nssm::ScorePredictions({tail.outputs}, {simulated->outputs}).rmse[0], stopped.after.simulate[0]);
}

TEST(AdaptTest, AContextTooShortIsRefusedWithTheNumberNeeded) {
  base::Executor* const executor = base::CallingThread();
  const nssm::Bundle bundle = *Train(SmallSpec(), Fleet(10, 80, 1), nullptr, executor, nullptr);
  const Trajectory system = Fleet(1, 7, 3).trajectories[0];
  const absl::Status status = Adapt(bundle, system, {.inner_loop = {.steps = 1}}, nullptr).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_NE(std::string(status.message()).find("7 samples given, 8 needed"), std::string::npos) << status;
  EXPECT_TRUE(Adapt(bundle, Fleet(1, 8, 3).trajectories[0], {.inner_loop = {.steps = 1}}, nullptr).ok());
  Trajectory with_nan = Fleet(1, 60, 3).trajectories[0];
  with_nan.outputs(0, 9) = std::nan("");
  EXPECT_NE(std::string(Adapt(bundle, with_nan, {}, nullptr).status().message()).find("sample 9"), std::string::npos);
}

TEST(AdaptTest, ZeroStepsLeaveTheModelAndFullyFrozenTensorsStay) {
  base::Executor* const executor = base::CallingThread();
  const nssm::Bundle bundle = *Train(SmallSpec(), Fleet(10, 80, 1), nullptr, executor, nullptr);
  const Trajectory system = Fleet(1, 60, 3).trajectories[0];
  EXPECT_EQ(Adapt(bundle, system, {.inner_loop = {.steps = 0}}, nullptr)->parameters, bundle.parameters);
  const AdaptationResult result =
      *Adapt(bundle, system, {.inner_loop = {.steps = 4, .learning_rate = 0.01, .adapted_mask = "transition.1"}}, nullptr);
  for (const nn::Tensor& tensor : bundle.model.layout().tensors()) {
    const bool adapts = tensor.name.rfind("transition.1", 0) == 0;
    const bool equal = std::equal(bundle.parameters.begin() + tensor.offset,
                                  bundle.parameters.begin() + tensor.offset + tensor.size(),
                                  result.parameters.begin() + tensor.offset);
    EXPECT_EQ(equal, !adapts) << tensor.name;
  }
}

TEST(AdaptTest, ASystemsOwnNoiseWidensByWhatTrainingFound) {
  nssm::Bundle bundle = *Train(SmallSpec(), Fleet(10, 80, 1), nullptr, base::CallingThread(), nullptr);
  const Trajectory system = Fleet(1, 60, 3).trajectories[0];
  const auto process = [&](double log_std, double own_widening) {
    bundle.noise.log_std = log_std;
    bundle.noise.own_widening = own_widening;
    return Adapt(bundle, system, *DefaultAdaptation(bundle), nullptr)->noise.process;
  };
  EXPECT_NEAR(process(1, 0.5)(0, 0), std::exp(0.5) * process(1, 0)(0, 0), 1e-12 * process(1, 0)(0, 0));
  EXPECT_EQ(process(0, 0.5), bundle.noise.process);  // nothing of its own
}

TEST(AdaptTest, BetterInFreeRunComparesAllOutputsTogether) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const auto errors = [](std::vector<double> simulate) { return TailErrors{.simulate = std::move(simulate)}; };
  EXPECT_TRUE(BetterInFreeRun(errors({1, 1}), errors({1, 1.1})));
  EXPECT_TRUE(BetterInFreeRun(errors({2, 1}), errors({1, 3})));  // twice as bad in one, three times as good in the other
  EXPECT_FALSE(BetterInFreeRun(errors({2, 1}), errors({1, 2})));
  EXPECT_TRUE(BetterInFreeRun(errors({9}), errors({nan})));  // what diverged is beaten
  EXPECT_TRUE(BetterInFreeRun(errors({9}), errors({})));
  EXPECT_FALSE(BetterInFreeRun(errors({nan}), errors({9})));
  EXPECT_FALSE(BetterInFreeRun(errors({}), errors({9})));
}

}  // namespace
}  // namespace metaekf::meta
