#include "core/meta/train.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "core/data/split.h"
#include "core/meta/adapt.h"
#include "core/meta/meta_gradient.h"
#include "tests/core/meta/small_training.h"

namespace metaekf::meta {
namespace {

using data::Dataset;
using data::Trajectory;

// Descent on a loss of another scale takes rates of the inverse scale: those that begin at the curvature do.
TEST(TrainScheduleTest, CurvatureRatesBeginAtTheScaleOfTheLoss) {
  const auto rates = [](double weight) {
    TrainingSpec spec = SmallSpec();
    spec.inner_loop.learned_rates = spec.inner_loop.curvature_rates = true;
    spec.inner_loop.learning_rate = 1;
    spec.adaptation = spec.inner_loop;
    spec.loss.state_weight = spec.loss.output_weight = weight;
    spec.loss.reconstruction_weight = 0;
    spec.warmup_iterations = 0;
    spec.iterations = 1;
    const nssm::Bundle bundle = *Train(spec, Fleet(10, 80, 1), nullptr, base::CallingThread(), nullptr);
    // What is kept are the rates themselves, not what they began as.
    EXPECT_FALSE(ReadTrainingSpec(*bundle.training)->inner_loop.curvature_rates);
    return DefaultAdaptation(bundle)->inner_loop.tensor_rates;
  };
  const std::map<std::string, double> of_one = rates(1), of_hundred = rates(100);
  ASSERT_EQ(of_one.size(), 4u);
  for (const auto& [name, rate] : of_one) {
    EXPECT_NEAR(of_hundred.at(name) * 100 / rate, 1, 0.05) << name;  // one outer step of a hundredth on their logarithms
  }
}

// L tensors step at 1/(L λ) each, for together they are as steep as the sum of their curvatures at most.
TEST(TrainScheduleTest, CurvatureRatesLeaveRoomForEachOther) {
  TrainingSpec spec = SmallSpec();
  spec.inner_loop.learned_rates = spec.inner_loop.curvature_rates = spec.contexts_at_start = true;
  spec.inner_loop.learning_rate = 0.5;
  spec.outer_lr = spec.final_outer_lr = 0;
  spec.warmup_iterations = 0;
  spec.iterations = 1;
  spec.validation_share = 0;
  const Dataset fleet = Fleet(1, 80, 1);
  const nssm::Bundle bundle = *Train(spec, fleet, nullptr, base::CallingThread(), nullptr);
  const TrainingSpec trained = *ReadTrainingSpec(*bundle.training);
  const nssm::LossShape shape = *nssm::ShapeOfLoss(trained.model, trained.loss, spec.context_samples);
  const MetaGradient<double> gradient(bundle.model, trained, shape, shape,
                                      *nn::ParseMask(spec.inner_loop.adapted_mask, bundle.model.layout()));
  MetaGradient<double>::Scratch scratch(gradient);
  const nssm::LossData<double> context = nssm::CutLossData<double>(
      trained.model, trained.loss, *data::Normalised(bundle.normaliser, fleet.trajectories[0]), 0, shape);
  const std::vector<double> curvatures = gradient.Curvatures(bundle.parameters.data(), context, &scratch);
  ASSERT_EQ(curvatures.size(), 4u);
  size_t l = 0;
  for (const nn::Tensor& tensor : bundle.model.layout().tensors()) {
    const auto rate = trained.inner_loop.tensor_rates.find(tensor.name);
    if (rate == trained.inner_loop.tensor_rates.end()) continue;  // it does not adapt
    EXPECT_NEAR(rate->second * 4 * curvatures[l++], 0.5, 1e-9) << tensor.name;
  }
}

/// Parameters after so many iterations.
std::vector<double> ParametersAfter(const TrainingSpec& spec, int32_t iterations) {
  std::vector<double> parameters;
  EXPECT_FALSE(Train(spec, Fleet(10, 80, 1), nullptr, base::CallingThread(), [&](const TrainingProgress& p) {
                 parameters = p.state.values.at("parameters");
                 return p.state.iteration < iterations;
               }).ok());
  return parameters;
}

TEST(TrainScheduleTest, RolloutsGrowByDoubling) {
  TrainingSpec growing = SmallSpec();
  growing.warmup_horizon = 2;
  growing.loss.horizon = 8;
  growing.horizon_growth_iterations = 10;  // of length 2 up to iteration 15, of 4 up to 20, then of 8
  const auto with_horizon = [&](int32_t horizon) {
    TrainingSpec constant = growing;
    constant.loss.horizon = horizon;
    constant.horizon_growth_iterations = 0;
    return constant;
  };
  EXPECT_EQ(ParametersAfter(growing, 15), ParametersAfter(with_horizon(2), 15));
  EXPECT_NE(ParametersAfter(growing, 16), ParametersAfter(with_horizon(2), 16));
  EXPECT_NE(ParametersAfter(growing, 16), ParametersAfter(with_horizon(8), 16));
  // The step at which the last length begins is that of a training resumed there with constant length.
  const auto state_after = [](const TrainingSpec& spec, const TrainingState* resume, int32_t iterations) {
    TrainingState state;
    EXPECT_FALSE(Train(spec, Fleet(10, 80, 1), resume, base::CallingThread(), [&](const TrainingProgress& p) {
                   state = p.state;
                   return p.state.iteration < iterations;
                 }).ok());
    return state;
  };
  for (const auto& [iteration, horizon] : {std::pair{16, 4}, {19, 4}, {20, 8}, {25, 8}}) {
    const TrainingState before = state_after(growing, nullptr, iteration);
    EXPECT_EQ(state_after(growing, &before, iteration + 1).values.at("parameters"),
              state_after(with_horizon(horizon), &before, iteration + 1).values.at("parameters"))
        << iteration;
  }
}

// Of whole sets of 40 and 30 samples: rollouts of 2, 4, 8, 16 samples, one after the other, then the sets themselves.
TEST(TrainScheduleTest, RolloutsGrowToWholeSets) {
  TrainingSpec growing = SmallSpec();
  growing.loss.horizon = nssm::LossSpec::kWholeSet;
  growing.target_samples = 30;
  growing.warmup_horizon = 2;
  growing.horizon_growth_iterations = 10;
  const auto with_horizon = [&](int32_t horizon, int32_t stride) {
    TrainingSpec constant = growing;
    constant.loss.horizon = horizon;
    constant.loss.stride = stride;
    constant.horizon_growth_iterations = 0;
    return constant;
  };
  EXPECT_EQ(ParametersAfter(growing, 12), ParametersAfter(with_horizon(2, 2), 12));
  EXPECT_NE(ParametersAfter(growing, 14), ParametersAfter(with_horizon(2, 2), 14));
  growing.iterations = 21;
  const absl::StatusOr<nssm::Bundle> bundle = Train(growing, Fleet(10, 80, 1), nullptr, base::CallingThread(), nullptr);
  EXPECT_TRUE(bundle.ok()) << bundle.status();
}

}  // namespace
}  // namespace metaekf::meta
