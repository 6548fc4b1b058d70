#include "core/meta/scratch_fit.h"

#include <gtest/gtest.h>

#include <cmath>

#include "core/data/split.h"
#include "tests/core/meta/resonators.h"

namespace metaekf::meta {
namespace {

using data::Trajectory;
using Eigen::Index;
using Eigen::MatrixXd;

constexpr int64_t kFuture = 300;  // samples after the context

struct Errors {
  double to_minimum, stopped_early;
};

/// Root mean square errors of fits to the first samples, in free run over the kFuture that follow.
Errors ErrorsAfter(int64_t context_samples, double noise, uint64_t seed) {
  nssm::ModelSpec spec;
  spec.input_size = spec.output_size = 1;
  spec.state_size = 0;
  spec.latent_size = 3;
  spec.window = 6;
  spec.transition.bypass = nssm::Bypass::kLinear;
  spec.transition.input_time = nssm::InputTime::kNext;
  spec.transition.block.hidden_widths = {8};
  spec.transition.block.output_scale = 0.1;
  spec.precision = nssm::Precision::kFloat64;
  spec.start = nssm::StartMode::kFitted;
  const nssm::LossSpec loss{.horizon = nssm::LossSpec::kWholeSet, .state_weight = 0, .reconstruction_weight = 0};
  const nssm::Model model = *nssm::Model::Create(spec);
  const FitPlan plan(model, loss, nn::Mask(model.layout().tensors().size(), true));
  MatrixXd clean;
  const Trajectory recording = Resonator(context_samples + kFuture, noise, seed, &clean);
  const Trajectory context = *data::FirstSamples(recording, context_samples);
  const auto error = [&](bool stop_early) {
    const SystemFit fit = *FitFromScratch(plan, model, loss, context, {.seed = seed, .stop_early = stop_early}, nullptr);
    const nssm::LossData<double> data = *plan.dynamics.Cut(recording);
    nssm::RolloutLeastSquares::Workspace workspace(plan.dynamics, data.shape);
    const MatrixXd predictions = plan.dynamics.Predictions(fit.parameters.data(), fit.fit.unknowns.tail(plan.dynamics.carry_size()), data, &workspace);
    return std::sqrt((predictions.rightCols(kFuture) - clean.rightCols(kFuture)).squaredNorm() / kFuture);
  };
  return {error(false), error(true)};
}

// 90 parameters, 80 samples: the minimum has learned the noise by heart.
TEST(ScratchFitTest, StoppingEarlyPredictsBetterAfterAFewNoisySamples) {
  double gained = 0;
  for (uint64_t seed = 1; seed <= 5; ++seed) {
    const Errors errors = ErrorsAfter(80, 0.4, seed);
    gained += std::log(errors.to_minimum / errors.stopped_early);
  }
  EXPECT_GT(gained / 5, std::log(1.5));
}

// Held out, a window of the model's own length would leave nothing to fit.
TEST(ScratchFitTest, ARecordingTooShortToHoldAnythingOutIsFittedWhole) {
  const auto fitted = [](bool stop_early) {
    nssm::ModelSpec spec;
    spec.input_size = spec.output_size = 1;
    spec.state_size = 0;
    spec.latent_size = 2;
    spec.window = 6;
    spec.precision = nssm::Precision::kFloat64;
    const nssm::LossSpec loss{.horizon = 4, .stride = 1, .state_weight = 0, .reconstruction_weight = 0};
    const nssm::Model model = *nssm::Model::Create(spec);
    const FitPlan plan(model, loss, nn::Mask(model.layout().tensors().size(), true));
    MatrixXd clean;
    const absl::StatusOr<SystemFit> fit =
        FitFromScratch(plan, model, loss, Resonator(12, 0.1, 1, &clean), {.seed = 1, .steps = 5, .stop_early = stop_early}, nullptr);
    EXPECT_TRUE(fit.ok()) << fit.status();
    return fit.ok() ? fit->parameters : std::vector<double>();
  };
  EXPECT_EQ(fitted(true), fitted(false));
}

// There is nothing to stop for: the fit goes on to the minimum of all samples, those that were held out too.
TEST(ScratchFitTest, StoppingEarlyTakesNothingFromAnExactFit) {
  const Errors errors = ErrorsAfter(500, 1e-4, 1);
  EXPECT_LT(errors.to_minimum, 1e-3);
  EXPECT_LT(errors.stopped_early, 1.2 * errors.to_minimum);
}

}  // namespace
}  // namespace metaekf::meta
