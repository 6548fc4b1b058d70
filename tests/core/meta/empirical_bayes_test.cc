#include "core/meta/empirical_bayes.h"

#include <gtest/gtest.h>

#include <Eigen/Eigenvalues>
#include <Eigen/Geometry>
#include <cmath>

#include "core/base/rng.h"
#include "core/meta/adapt.h"
#include "core/meta/arx.h"
#include "core/meta/train.h"
#include "core/nssm/model_file.h"
#include "core/nssm/predict.h"

namespace metaekf::meta {
namespace {

using data::Dataset;
using data::Trajectory;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double kNoise = 0.02;

/// Damped resonators of unknown frequency and damping, x measured only through y = x₁ + noise.
Dataset Resonators(size_t systems, int64_t length, uint64_t seed) {
  Dataset fleet{.input_names = {"u1"}, .output_names = {"y1"}};
  for (size_t s = 0; s < systems; ++s) {
    base::Rng rng(seed, s);
    const double angle = rng.Uniform(0.3, 0.5), radius = rng.Uniform(0.9, 0.95);
    Trajectory t{.name = std::to_string(s), .sample_period_s = 0.1};
    t.inputs.resize(1, length);
    t.outputs.resize(1, length);
    t.states.resize(0, length);
    Eigen::Vector2d x = Eigen::Vector2d::Zero();
    for (Index k = 0; k < length; ++k) {
      t.inputs(0, k) = rng.Normal();
      const Eigen::Rotation2D<double> rotation(angle);
      x = radius * (rotation * x);
      x[0] += t.inputs(0, k);
      x[1] -= 0.2 * std::tanh(x[0]);
      t.outputs(0, k) = x[0] + kNoise * rng.Normal();
    }
    fleet.trajectories.push_back(std::move(t));
  }
  return fleet;
}

TrainingSpec Spec() {
  TrainingSpec spec;
  spec.model.state_size = 0;
  spec.model.latent_size = 2;
  spec.model.window = 6;
  spec.model.transition.bypass = nssm::Bypass::kLinear;
  spec.model.transition.input_time = nssm::InputTime::kNext;
  spec.model.transition.block.hidden_widths = {2};
  spec.model.transition.block.output_scale = 0.1;
  spec.model.precision = nssm::Precision::kFloat64;
  spec.model.start = nssm::StartMode::kFitted;
  spec.loss = {.horizon = nssm::LossSpec::kWholeSet, .state_weight = 0, .reconstruction_weight = 0};
  spec.algorithm = Algorithm::kGaussianPrior;
  spec.adaptation = {.steps = 40, .optimiser = Optimiser::kLevenbergMarquardt};
  spec.gaussian_prior = {.rounds = 2, .restarts = 3, .first_steps = 30, .round_steps = 8};
  spec.context_samples = 60;
  spec.target_samples = 150;
  spec.seed = 3;
  return spec;
}

std::string TrainedFile(size_t threads, const TrainingState* resume = nullptr) {
  const auto executor = base::MakeThreadExecutor(threads);
  const absl::StatusOr<nssm::Bundle> bundle = Train(Spec(), Resonators(12, 300, 1), resume, executor.get(), nullptr);
  EXPECT_TRUE(bundle.ok()) << bundle.status();
  return bundle.ok() ? nssm::WriteModelFile(*bundle) : "";
}

TEST(EmpiricalBayesTest, AFewSamplesOfANewSystemAreEnoughToSimulateIt) {
  const nssm::Bundle bundle = *nssm::ReadModelFile(TrainedFile(2));
  ASSERT_TRUE(bundle.prior);
  EXPECT_GT(bundle.prior->examples.cols(), 5);
  double adapted_errors = 0, unadapted_errors = 0;
  for (uint64_t seed = 100; seed < 105; ++seed) {
    const Trajectory system = Resonators(1, 800, seed).trajectories[0];
    Trajectory context = system;
    context.inputs = system.inputs.leftCols(40).eval();
    context.outputs = system.outputs.leftCols(40).eval();
    context.states.resize(0, 40);
    const absl::StatusOr<AdaptationResult> result = Adapt(bundle, context, *DefaultAdaptation(bundle), nullptr);
    ASSERT_TRUE(result.ok()) << result.status();
    nssm::Bundle adapted = bundle;
    adapted.parameters = result->parameters;
    const auto error = [&](const nssm::Bundle& model) {
      return nssm::ScorePredictions({system.outputs}, {nssm::Predict(model, system, nssm::PredictionMode::kSimulate)->outputs}).rmse[0];
    };
    adapted_errors += error(adapted);
    unadapted_errors += error(bundle);
    EXPECT_LT(error(adapted), 0.1) << "the signal's standard deviation is about 2, the noise's " << kNoise;
    // The posterior is surer than the prior in every direction, and says so.
    const Index p = bundle.prior->dynamics.rows();
    const MatrixXd gained = result->information.topLeftCorner(p, p) - bundle.prior->dynamics;
    const VectorXd eigenvalues = gained.selfadjointView<Eigen::Lower>().eigenvalues();
    EXPECT_GT(eigenvalues.minCoeff(), -1e-9 * eigenvalues.maxCoeff());
  }
  EXPECT_LT(adapted_errors, 0.1 * unadapted_errors);
}

TEST(EmpiricalBayesTest, TheNoiseOfTheFleetIsFoundOut) {
  const nssm::Bundle bundle = *nssm::ReadModelFile(TrainedFile(2));
  const double scale = bundle.normaliser.outputs.scale[0];
  EXPECT_NEAR(std::sqrt(bundle.prior->noise_variance[0]) * scale, kNoise, 0.3 * kNoise);
}

TEST(EmpiricalBayesTest, TheResultIsBitIdenticalWhateverTheNumberOfThreads) {
  EXPECT_TRUE(TrainedFile(1) == TrainedFile(3));
}

TEST(EmpiricalBayesTest, AResumedTrainingEqualsAnUninterruptedOne) {
  const auto executor = base::MakeSerialExecutor();
  const std::string whole = TrainedFile(1);
  for (const int32_t stop : {3, 11, 20, 33}) {  // after the first fit, inside of rounds, at the very end
    std::string checkpoint;
    const absl::Status status = Train(Spec(), Resonators(12, 300, 1), nullptr, executor.get(), [&](const TrainingProgress& p) {
                                  checkpoint = WriteCheckpoint(p.state, "digest");
                                  return p.state.iteration < stop;
                                }).status();
    EXPECT_EQ(status.code(), absl::StatusCode::kCancelled);
    const absl::StatusOr<TrainingState> state = ReadCheckpoint(checkpoint, "digest");
    ASSERT_TRUE(state.ok()) << state.status();
    EXPECT_TRUE(TrainedFile(2, &*state) == whole) << "stopped at " << stop;
  }
}

TEST(EmpiricalBayesTest, APriorOfOtherUnknownsIsRefused) {
  nssm::Bundle bundle = *nssm::ReadModelFile(TrainedFile(2));
  AdaptationOptions options = *DefaultAdaptation(bundle);
  options.inner_loop.adapted_mask = "transition";
  const absl::Status status = Adapt(bundle, Resonators(1, 100, 9).trajectories[0], options, nullptr).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << status;
}

}  // namespace
}  // namespace metaekf::meta
