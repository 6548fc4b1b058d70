#include "core/meta/empirical_bayes.h"

#include <gtest/gtest.h>

#include <Eigen/Eigenvalues>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>

#include "core/data/split.h"
#include "core/filter/ekf.h"
#include "core/meta/adapt.h"
#include "core/meta/arx.h"
#include "core/meta/covariance_structure.h"
#include "core/meta/scratch_fit.h"
#include "core/meta/train.h"
#include "core/nssm/model_file.h"
#include "core/nssm/predict.h"
#include "tests/core/meta/resonators.h"
#include "tests/core/nssm/random_models.h"

namespace metaekf::meta {
namespace {

using data::Dataset;
using data::Trajectory;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double kNoise = 0.02;

Dataset Resonators(size_t systems, int64_t length, uint64_t seed) { return ResonatorFleet(systems, length, kNoise, seed); }

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

std::string TrainedFile(size_t threads, const TrainingState* resume = nullptr, const TrainingSpec& spec = Spec()) {
  const auto executor = base::MakeThreadExecutor(threads);
  const absl::StatusOr<nssm::Bundle> bundle = Train(spec, Resonators(12, 300, 1), resume, executor.get(), nullptr);
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
    const MatrixXd gained = result->posterior->information - bundle.prior->dynamics;
    const VectorXd eigenvalues = gained.selfadjointView<Eigen::Lower>().eigenvalues();
    EXPECT_GT(eigenvalues.minCoeff(), -1e-9 * eigenvalues.maxCoeff());
  }
  EXPECT_LT(adapted_errors, 0.1 * unadapted_errors);
}

TEST(EmpiricalBayesTest, FiltersOfNewSystemsHoldTheTruth) {
  const nssm::Bundle bundle = *nssm::ReadModelFile(TrainedFile(2));
  const std::shared_ptr<filter::FilterModel> model = filter::FilterModel::Create(bundle);
  const auto scratch = model->MakeScratch();
  int held = 0, all = 0;
  double nis = 0;
  for (uint64_t seed = 100; seed < 120; ++seed) {
    MatrixXd clean;
    Trajectory system = Resonator(400, kNoise, seed, &clean);
    AdaptationResult result = *Adapt(bundle, *data::FirstSamples(system, 100), *DefaultAdaptation(bundle), nullptr);
    nssm::Bundle adapted = bundle;
    adapted.parameters = std::move(result.parameters);
    adapted.posterior = std::move(result.posterior);
    adapted.noise = std::move(result.noise);
    filter::Ekf ekf = *filter::Ekf::Create(adapted, model, model->Prepare(adapted), {});
    filter::Estimate estimate = ekf.MakeEstimate();
    for (Eigen::Index t = 100; t < 400; ++t) {
      ASSERT_TRUE(ekf.Step(system.inputs.col(t), system.outputs.col(t), scratch.get(), &estimate).ok());
      if (estimate.health == filter::Health::kWarmingUp || estimate.measured == 0) continue;
      held += std::abs(estimate.mean[0] - clean(0, t)) <= 1.96 * std::sqrt(estimate.cov(0, 0)) ? 1 : 0;
      nis += estimate.nis;
      ++all;
    }
  }
  EXPECT_NEAR(static_cast<double>(held) / all, 0.95, 0.03);
  EXPECT_NEAR(nis / all, 1, 0.1);
}

TrainingSpec WithFactors(int32_t rank) {
  TrainingSpec spec = Spec();
  spec.gaussian_prior.covariance = PriorCovariance::kLowRank;
  spec.gaussian_prior.rank = rank;
  return spec;
}

TrainingSpec OnAManifold(int32_t rank) {
  TrainingSpec spec = Spec();
  spec.gaussian_prior.covariance = PriorCovariance::kManifold;
  spec.gaussian_prior.rank = rank;
  return spec;
}

// Frequency and damping are two numbers, and a few more directions straighten the curve that they draw among parameters.
TEST(EmpiricalBayesTest, OnAManifoldASystemIsAFewNumbers) {
  const nssm::Bundle bundle = *nssm::ReadModelFile(TrainedFile(2, nullptr, OnAManifold(4)));
  ASSERT_LE(bundle.prior->loadings.cols(), 4);
  double adapted_errors = 0, unadapted_errors = 0;
  for (uint64_t seed = 100; seed < 105; ++seed) {
    const Trajectory system = Resonators(1, 800, seed).trajectories[0];
    const absl::StatusOr<AdaptationResult> result =
        Adapt(bundle, *data::FirstSamples(system, 40), *DefaultAdaptation(bundle), nullptr);
    ASSERT_TRUE(result.ok()) << result.status();
    nssm::Bundle adapted = bundle;
    adapted.parameters = result->parameters;
    ASSERT_TRUE(result->posterior);
    adapted.posterior.emplace(*result->posterior);
    ASSERT_EQ(adapted.posterior->coordinates.size(), bundle.prior->loadings.cols());
    EXPECT_EQ(adapted.posterior->information.rows(), bundle.prior->loadings.cols());
    // What is stored is that and no more, and gives the same model bit for bit.
    const std::string stored = nssm::WriteAdaptedSubset(adapted, result->mask);
    EXPECT_LT(stored.size(), 700u);
    nssm::Bundle restored = bundle;
    ASSERT_TRUE(nssm::ApplyAdaptedSubset(stored, &restored).ok());
    EXPECT_EQ(restored.parameters, adapted.parameters);
    EXPECT_EQ(restored.posterior->coordinates, adapted.posterior->coordinates);
    EXPECT_EQ(restored.posterior->information, adapted.posterior->information);
    const auto error = [&](const nssm::Bundle& model) {
      return nssm::ScorePredictions({system.outputs}, {nssm::Predict(model, system, nssm::PredictionMode::kSimulate)->outputs}).rmse[0];
    };
    adapted_errors += error(adapted);
    unadapted_errors += error(bundle);
  }
  EXPECT_LT(adapted_errors, 0.2 * unadapted_errors);
}

TEST(EmpiricalBayesTest, APriorOfTwoFactorsIsOneAndIsAdaptedUnder) {
  const nssm::Bundle bundle = *nssm::ReadModelFile(TrainedFile(2, nullptr, WithFactors(2)));
  // Frequency and damping are two numbers: beside two factors each parameter has but a variance of its own.
  const MatrixXd covariance = bundle.prior->dynamics.inverse();
  const FactorModel model = FitFactors(covariance, 2, {.max_iterations = 1000, .tolerance = 1e-9});
  EXPECT_LT((model.Covariance() - covariance).norm(), 1e-6 * covariance.norm());
  double adapted_errors = 0, unadapted_errors = 0;
  for (uint64_t seed = 100; seed < 105; ++seed) {
    const Trajectory system = Resonators(1, 800, seed).trajectories[0];
    const Trajectory context = *data::FirstSamples(system, 60);
    nssm::Bundle adapted = bundle;
    adapted.parameters = AdaptedBundle(bundle, context, *DefaultAdaptation(bundle))->parameters;
    const auto error = [&](const nssm::Bundle& model_of) {
      return nssm::ScorePredictions({system.outputs}, {nssm::Predict(model_of, system, nssm::PredictionMode::kSimulate)->outputs}).rmse[0];
    };
    adapted_errors += error(adapted);
    unadapted_errors += error(bundle);
  }
  EXPECT_LT(adapted_errors, 0.2 * unadapted_errors);
}

TEST(EmpiricalBayesTest, APriorOfFactorsIsBitIdenticalWhateverTheThreadsAndResumed) {
  for (const TrainingSpec& spec : {WithFactors(2), OnAManifold(4)}) {
    const std::string whole = TrainedFile(3, nullptr, spec);
    base::Executor* const executor = base::CallingThread();
    std::string checkpoint;
    const absl::Status status = Train(spec, Resonators(12, 300, 1), nullptr, executor, [&](const TrainingProgress& p) {
                                  checkpoint = WriteCheckpoint(p.state, "digest");
                                  return p.state.iteration < 20;
                                }).status();
    EXPECT_EQ(status.code(), absl::StatusCode::kCancelled);
    const TrainingState state = *ReadCheckpoint(checkpoint, "digest");
    EXPECT_TRUE(TrainedFile(2, &state, spec) == whole);
  }
}

TEST(EmpiricalBayesTest, MoreFactorsThanParametersAreRefusedBeforeAnythingIsFitted) {
  base::Executor* const executor = base::CallingThread();
  const absl::Status status = Train(WithFactors(1000), Resonators(12, 300, 1), nullptr, executor, nullptr).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(status.message().substr(0, 20), "gaussian_prior.rank:");
}

/// ŷ = Φθ with Φ of a fixed linear encoder and transition: only the output decoder θ differs from system to system.
TrainingSpec LinearFamily() {
  TrainingSpec spec;
  spec.model = {.kind = nssm::Case::kInputOutput, .input_size = 1, .output_size = 1, .state_size = 0};
  spec.model.latent_size = spec.model.window = 2;
  spec.model.precision = nssm::Precision::kFloat64;
  spec.loss = {.horizon = 1, .rollout = nssm::RolloutMode::kLatent, .state_weight = 0, .reconstruction_weight = 0};
  spec.algorithm = Algorithm::kGaussianPrior;
  spec.gaussian_prior = {.initial_std = 0.5, .rounds = 0, .restarts = 2, .first_steps = 60};
  return spec;
}

// Of a linear family with Gaussian noise both steps are linear algebra, written out here. The fits end when a step brings
// less than 1e-5 of the cost, so they are a per mille off.
TEST(EmpiricalBayesTest, OneRoundOnALinearFamilyIsItsClosedForm) {
  const TrainingSpec spec = LinearFamily();
  const nssm::Model model = *nssm::Model::Create(spec.model);
  const nn::Mask mask = *nn::ParseMask("output_decoder", model.layout());
  Systems systems;
  for (uint64_t seed = 0; seed < 7; ++seed) systems.training.push_back(nssm::RandomTrajectory(spec.model, 60, 20 + seed));
  base::Executor* const executor = base::CallingThread();
  TrainingState state;
  const absl::StatusOr<LearnedPrior> learned = LearnGaussianPrior(spec, model, mask, systems, {}, executor, &state, nullptr);
  ASSERT_TRUE(learned.ok()) << learned.status();

  const FitPlan plan(model, spec.loss, mask);
  const nssm::RolloutLeastSquares& problem = plan.dynamics;
  const SystemFit first = *FitFromScratch(plan, model, spec.loss, systems.training[0],
                                          {.seed = spec.seed, .restarts = 2, .steps = 60}, nullptr);
  const Index p = problem.unknowns();
  const VectorXd m = first.fit.unknowns;
  const MatrixXd precision = MatrixXd::Identity(p, p) / 0.25;
  const double variance = first.fit.noise_variance[0];
  std::vector<VectorXd> fits;
  VectorXd mean = VectorXd::Zero(p);
  MatrixXd covariance = MatrixXd::Zero(p, p);
  std::vector<double> variances;
  for (const Trajectory& system : systems.training) {
    const nssm::LossData<double> data = *problem.Cut(system);
    nssm::RolloutLeastSquares::Workspace workspace(problem, data.shape);
    const auto predictions = [&](const VectorXd& theta) -> VectorXd {
      std::vector<double> parameters = first.parameters;
      ScatterAdapted(problem, theta, &parameters);
      return problem.Predictions(parameters.data(), VectorXd(), data, &workspace).reshaped();
    };
    MatrixXd phi(data.outputs.size(), p);
    for (Index i = 0; i < p; ++i) phi.col(i) = predictions(VectorXd::Unit(p, i)) - predictions(VectorXd::Zero(p));
    const VectorXd y = Eigen::Map<const VectorXd>(data.outputs.data(), phi.rows());
    const MatrixXd posterior = (precision + phi.transpose() * phi / variance).inverse();
    fits.push_back(posterior * (precision * m + phi.transpose() * y / variance));
    mean += fits.back() / 7;
    covariance += posterior / 7;
    const double determined = static_cast<double>(p) - (posterior * precision).trace();
    variances.push_back((phi * fits.back() - y).squaredNorm() / (static_cast<double>(phi.rows()) - determined));
  }
  for (const VectorXd& fit : fits) covariance += (fit - mean) * (fit - mean).transpose() / 7;
  std::sort(variances.begin(), variances.end());

  EXPECT_LT((GatherAdapted(problem, learned->parameters) - mean).norm(), 5e-3 * mean.norm());
  EXPECT_LT((learned->prior.dynamics.inverse() - covariance).norm(), 5e-3 * covariance.norm());
  EXPECT_NEAR(learned->prior.noise_variance[0], variances[3], 1e-3 * variances[3]);
}

// A restart begins from a random network of its own, which the prior has to keep where it does not adapt: the expected
// values are the first fit's.
TEST(EmpiricalBayesTest, WhatDoesNotAdaptStaysAsInTheFirstFit) {
  TrainingSpec spec = Spec();
  spec.model.input_size = spec.model.output_size = 1;
  spec.gaussian_prior.rounds = 1;
  const nssm::Model model = *nssm::Model::Create(spec.model);
  const nn::Mask mask = *nn::ParseMask("transition.*_bypass,output_decoder", model.layout());
  const Systems systems{.training = Resonators(4, 150, 1).trajectories};
  base::Executor* const executor = base::CallingThread();
  TrainingState state;
  const absl::StatusOr<LearnedPrior> learned =
      LearnGaussianPrior(spec, model, mask, systems, {}, executor, &state, nullptr);
  ASSERT_TRUE(learned.ok()) << learned.status();
  const GaussianPriorSpec& options = spec.gaussian_prior;
  const absl::StatusOr<SystemFit> first =
      FitFromScratch(FitPlan(model, spec.loss, mask), model, spec.loss, systems.training[0],
                     {.seed = spec.seed, .restarts = options.restarts, .steps = options.first_steps}, nullptr);
  ASSERT_TRUE(first.ok()) << first.status();
  for (size_t i = 0; i < mask.size(); ++i) {
    const nn::Tensor& tensor = model.layout().tensors()[i];
    for (int64_t k = tensor.offset; !mask[i] && k < tensor.offset + tensor.size(); ++k) {
      EXPECT_EQ(learned->parameters[static_cast<size_t>(k)], first->parameters[static_cast<size_t>(k)]) << tensor.name;
    }
  }
}

TEST(EmpiricalBayesTest, TheNoiseOfTheFleetIsFoundOut) {
  const nssm::Bundle bundle = *nssm::ReadModelFile(TrainedFile(2));
  ASSERT_TRUE(bundle.prior);
  const double scale = bundle.normaliser.outputs.scale[0];
  EXPECT_NEAR(std::sqrt(bundle.prior->noise_variance[0]) * scale, kNoise, 0.3 * kNoise);
}

TEST(EmpiricalBayesTest, TheResultIsBitIdenticalWhateverTheNumberOfThreads) {
  EXPECT_TRUE(TrainedFile(1) == TrainedFile(3));
}

TEST(EmpiricalBayesTest, AResumedTrainingEqualsAnUninterruptedOne) {
  base::Executor* const executor = base::CallingThread();
  const std::string whole = TrainedFile(1);
  for (const int32_t stop : {3, 11, 20, 33}) {  // after the first fit, inside of rounds, at the very end
    std::string checkpoint;
    const absl::Status status = Train(Spec(), Resonators(12, 300, 1), nullptr, executor, [&](const TrainingProgress& p) {
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
