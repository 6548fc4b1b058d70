#include "core/meta/train.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>

#include "core/data/split.h"
#include "core/meta/adapt.h"
#include "core/meta/meta_gradient.h"
#include "tests/core/meta/small_training.h"
#include "core/nssm/model_file.h"

namespace metaekf::meta {
namespace {

using data::Dataset;
using Eigen::Index;
using Eigen::MatrixXd;
using data::Trajectory;

std::string TrainedFile(const TrainingSpec& spec, size_t threads, const TrainingState* resume = nullptr) {
  const auto executor = base::MakeThreadExecutor(threads);
  const absl::StatusOr<nssm::Bundle> bundle = Train(spec, Fleet(10, 80, 1), resume, executor.get(), nullptr);
  EXPECT_TRUE(bundle.ok()) << bundle.status();
  return bundle.ok() ? nssm::WriteModelFile(*bundle) : "";
}

struct Variant {
  std::string name;
  TrainingSpec spec;
};

/// Every algorithm of the outer loop with every inner loop that it takes.
std::vector<Variant> Variants() {
  std::vector<Variant> variants;
  const auto add = [&](const std::string& name, Algorithm algorithm, Optimiser optimiser, bool learned_rates) {
    TrainingSpec spec = SmallSpec();
    spec.algorithm = algorithm;
    spec.inner_loop.optimiser = spec.adaptation.optimiser = optimiser;
    spec.inner_loop.learned_rates = spec.adaptation.learned_rates = learned_rates;
    if (algorithm == Algorithm::kImplicitMaml) spec.inner_loop.proximal = 30;  // three steps come near the minimum
    variants.push_back({name + (learned_rates ? "WithRates" : ""), spec});
  };
  for (const auto& [suffix, optimiser] : {std::pair{"", Optimiser::kGradientDescent}, {"WithAdam", Optimiser::kAdam}}) {
    add(std::string("Maml") + suffix, Algorithm::kMaml, optimiser, false);
    add(std::string("Maml") + suffix, Algorithm::kMaml, optimiser, true);
    add(std::string("FirstOrderMaml") + suffix, Algorithm::kFirstOrderMaml, optimiser, true);
    add(std::string("Reptile") + suffix, Algorithm::kReptile, optimiser, false);
    add(std::string("ImplicitMaml") + suffix, Algorithm::kImplicitMaml, optimiser, false);
  }
  add("FirstOrderMaml", Algorithm::kFirstOrderMaml, Optimiser::kGradientDescent, false);
  add("MamlWithGrowingRollouts", Algorithm::kMaml, Optimiser::kGradientDescent, false);
  variants.back().spec.horizon_growth_iterations = 10;
  add("MamlFromSeveralStarts", Algorithm::kMaml, Optimiser::kGradientDescent, false);
  variants.back().spec.restarts = 2;
  variants.back().spec.screening_iterations = 10;  // one of the stops below is the end of a start
  add("Supervised", Algorithm::kSupervised, Optimiser::kGradientDescent, false);
  add("ImplicitMamlByLevenbergMarquardt", Algorithm::kImplicitMaml, Optimiser::kLevenbergMarquardt, false);
  TrainingSpec& by_least_squares = variants.back().spec;
  by_least_squares.loss.reconstruction_weight = 0;
  by_least_squares.inner_loop.proximal = by_least_squares.adaptation.proximal = 0.3;
  by_least_squares.inner_loop.steps = by_least_squares.adaptation.steps = 12;
  add("MixedEffects", Algorithm::kMixedEffects, Optimiser::kGradientDescent, false);
  for (const Algorithm meta : {Algorithm::kMaml, Algorithm::kMixedEffects}) {
    add(meta == Algorithm::kMaml ? "GaussianPriorAfterMaml" : "GaussianPriorAfterMixedEffects", Algorithm::kGaussianPrior,
        Optimiser::kGradientDescent, meta == Algorithm::kMaml);
    TrainingSpec& prior = variants.back().spec;
    prior.gaussian_prior = {.meta_iterations = 20, .meta_algorithm = meta, .rounds = 1, .first_steps = 4, .round_steps = 3};
    prior.inner_loop.adapted_mask = "transition.1";
    prior.adaptation = {.steps = 5, .adapted_mask = "transition.1", .optimiser = Optimiser::kLevenbergMarquardt};
  }
  return variants;
}

class EveryAlgorithmTest : public ::testing::TestWithParam<Variant> {};

INSTANTIATE_TEST_SUITE_P(TrainTest, EveryAlgorithmTest, ::testing::ValuesIn(Variants()),
                         [](const auto& variant) { return variant.param.name; });

TEST_P(EveryAlgorithmTest, IsBitIdenticalWhateverTheNumberOfThreads) {
  TrainingSpec narrow = GetParam().spec;
  narrow.model.precision = nssm::Precision::kFloat32;
  EXPECT_EQ(TrainedFile(GetParam().spec, 1), TrainedFile(GetParam().spec, 3));
  EXPECT_EQ(TrainedFile(narrow, 1), TrainedFile(narrow, 2));
}

TEST_P(EveryAlgorithmTest, ResumedEqualsUninterrupted) {
  const TrainingSpec& spec = GetParam().spec;
  base::Executor* const executor = base::CallingThread();
  for (const int32_t stop : {7, 10, 21}) {  // in the warm-up, at its end, behind it
    std::string checkpoint;
    const absl::Status status = Train(spec, Fleet(10, 80, 1), nullptr, executor, [&](const TrainingProgress& p) {
                                  if (p.state.iteration == stop) checkpoint = WriteCheckpoint(p.state, "digest");
                                  return p.state.iteration < stop;
                                }).status();
    EXPECT_EQ(status.code(), absl::StatusCode::kCancelled);
    const absl::StatusOr<TrainingState> state = ReadCheckpoint(checkpoint, "digest");
    ASSERT_TRUE(state.ok()) << state.status();
    EXPECT_EQ(TrainedFile(spec, 2, &*state), TrainedFile(spec, 1)) << "stopped at " << stop;
  }
}

TEST_P(EveryAlgorithmTest, LowersTheLossOfHeldOutSystems) {
  if (GetParam().spec.algorithm == Algorithm::kGaussianPrior) GTEST_SKIP() << "MAML and the rounds after it are judged by different losses";
  if (GetParam().spec.algorithm == Algorithm::kMixedEffects) GTEST_SKIP() << "effects of training systems are no model of others";
  TrainingSpec spec = GetParam().spec;
  spec.iterations = 200;
  std::vector<double> losses;
  const auto executor = base::MakeThreadExecutor(2);
  const absl::Status status = Train(spec, Fleet(10, 80, 1), nullptr, executor.get(), [&](const TrainingProgress& p) {
                                if (p.validated) losses.push_back(p.state.validation_loss);
                                return true;
                              }).status();
  ASSERT_TRUE(status.ok()) << status;
  EXPECT_LT(losses.back(), 0.5 * losses.front());
}

TEST(TrainTest, LearnedRatesGoIntoTheModelFileAndAreAdaptedWith) {
  TrainingSpec spec = SmallSpec();
  spec.inner_loop.learned_rates = spec.adaptation.learned_rates = true;
  spec.iterations = 60;
  base::Executor* const executor = base::CallingThread();
  const absl::StatusOr<nssm::Bundle> trained = Train(spec, Fleet(10, 80, 1), nullptr, executor, nullptr);
  ASSERT_TRUE(trained.ok()) << trained.status();
  const nssm::Bundle bundle = *nssm::ReadModelFile(nssm::WriteModelFile(*trained));
  const AdaptationOptions options = *DefaultAdaptation(bundle);
  const std::map<std::string, double>& rates = options.inner_loop.tensor_rates;
  ASSERT_EQ(rates.size(), 4u);  // weights and biases of the transition's two layers
  for (const auto& [name, rate] : rates) {
    EXPECT_EQ(name.rfind("transition.", 0), 0u) << name;
    EXPECT_GT(rate, 0);
    EXPECT_NE(rate, 0.02);
  }
  const Trajectory system = Fleet(1, 60, 3).trajectories[0];
  AdaptationOptions one_rate = options;
  one_rate.inner_loop.tensor_rates.clear();
  EXPECT_NE(AdaptedBundle(bundle, system, options)->parameters, AdaptedBundle(bundle, system, one_rate)->parameters);
  EXPECT_TRUE(DefaultAdaptation(bundle, AdaptationMethod::kAdam)->inner_loop.tensor_rates.empty());
  AdaptationOptions unknown = options;
  unknown.inner_loop.tensor_rates = {{"engine", 1}};
  EXPECT_NE(std::string(AdaptedBundle(bundle, system, unknown).status().message()).find("\"engine\""), std::string::npos);
}

// What does not adapt is what MAML has found, whatever the fits that follow do with the rest.
TEST(TrainTest, APriorAfterMamlKeepsWhatDoesNotAdapt) {
  TrainingSpec spec = SmallSpec();
  spec.inner_loop.adapted_mask = spec.adaptation.adapted_mask = "transition.1";
  spec.iterations = 20;
  spec.validation_period = 5;
  const nssm::Bundle by_maml = *Train(spec, Fleet(10, 80, 1), nullptr, base::CallingThread(), nullptr);
  spec.algorithm = Algorithm::kGaussianPrior;
  spec.gaussian_prior = {.meta_iterations = 20, .rounds = 1, .first_steps = 4, .round_steps = 3};
  spec.adaptation.optimiser = Optimiser::kLevenbergMarquardt;
  const absl::StatusOr<nssm::Bundle> prior = Train(spec, Fleet(10, 80, 1), nullptr, base::CallingThread(), nullptr);
  ASSERT_TRUE(prior.ok()) << prior.status();
  int64_t adapted = 0;
  for (const nn::Tensor& tensor : prior->model.layout().tensors()) {
    const auto begin = static_cast<size_t>(tensor.offset), end = begin + static_cast<size_t>(tensor.size());
    const bool same = std::equal(prior->parameters.begin() + static_cast<std::ptrdiff_t>(begin), prior->parameters.begin() + static_cast<std::ptrdiff_t>(end),
                                 by_maml.parameters.begin() + static_cast<std::ptrdiff_t>(begin));
    EXPECT_EQ(same, tensor.name.rfind("transition.1", 0) != 0) << tensor.name;
    if (!same) adapted += tensor.size();
  }
  EXPECT_EQ(prior->prior->dynamics.rows(), adapted);
}

// x⁺ = x + 0.1 (−x + u + c) with c of a system's own: a linear model with a bias for every system has D δ_s = 0.1 (c_s − mean c).
TEST(TrainTest, MixedEffectsAreWhatSystemsDifferIn) {
  constexpr Index kSystems = 6, kSteps = 80;
  data::Dataset fleet{.input_names = {"u1"}, .output_names = {"y1"}, .state_names = {"x1"}};
  Eigen::RowVectorXd c(kSystems);
  for (Index s = 0; s < kSystems; ++s) {
    base::Rng rng(3, static_cast<uint64_t>(s));
    c[s] = rng.Normal();
    data::Trajectory t{.name = std::to_string(s), .sample_period_s = 0.1, .inputs = MatrixXd(1, kSteps), .states = MatrixXd(1, kSteps)};
    double x = rng.Normal();
    for (Index k = 0; k < kSteps; ++k) {
      t.inputs(0, k) = rng.Normal();
      t.states(0, k) = x;
      x += 0.1 * (-x + t.inputs(0, k) + c[s]);
    }
    t.outputs = t.states;
    fleet.trajectories.push_back(std::move(t));
  }
  TrainingSpec spec = SmallSpec();
  spec.algorithm = Algorithm::kMixedEffects;
  spec.model.transition.block.hidden_widths = {};
  spec.inner_loop.adapted_mask = "transition.0.bias";
  spec.inner_loop.proximal = 0;
  spec.validation_share = 0;
  spec.iterations = 2000;
  spec.final_outer_lr = 1e-4;
  std::vector<double> variables;
  const absl::StatusOr<nssm::Bundle> bundle = Train(spec, fleet, nullptr, base::CallingThread(), [&variables](const TrainingProgress& progress) {
    variables = progress.state.values.at("parameters");
    return true;
  });
  ASSERT_TRUE(bundle.ok()) << bundle.status();
  const Index size = bundle->model.layout().size(), adapted = 3;
  ASSERT_EQ(static_cast<Index>(variables.size()), size + kSystems * adapted);
  const Eigen::Map<const MatrixXd> own(variables.data() + size, adapted, kSystems);
  const nn::ParameterLayout& layout = bundle->model.layout();
  std::vector<double> parameters = bundle->parameters;
  const MatrixXd decoder = nn::TensorIn(layout, "state_decoder.0.weight", parameters);
  const Eigen::RowVectorXd effect = decoder * own, expected = 0.1 * (c.array() - c.mean()) / bundle->normaliser.states.scale[0];
  EXPECT_LT(((effect.array() - effect.mean()).matrix() - expected).norm(), 0.02 * expected.norm()) << effect << "\n" << expected;
  // Their mean is the model's.
  const MatrixXd bias = nn::TensorIn(layout, "transition.0.bias", parameters);
  std::vector<double> shared(variables.begin(), variables.begin() + size);
  EXPECT_LT((bias - nn::TensorIn(layout, "transition.0.bias", shared) - own.rowwise().mean()).norm(), 1e-12);
}

// Sensors that are alike in one fleet and differ by powers of ten in the other: what a context says of its own noise counts there. Twenty samples
// say it with an error, and bounds must hold all the same.
TEST(TrainTest, HowFarSystemsNoisesAreApartIsLearned) {
  const auto found = [](double spread) {
    data::Dataset fleet = Fleet(20, 400, 1);
    for (size_t s = 0; s < fleet.trajectories.size(); ++s) {
      base::Rng rng(9, s);
      data::Trajectory& system = fleet.trajectories[s];
      for (Index t = 0; t + 1 < system.length(); ++t) {  // the same a and the same disturbances for all
        system.states(0, t + 1) = 0.9 * system.states(0, t) + 0.1 * system.inputs(0, t) + 0.02 * rng.Normal();
      }
      system.outputs = system.states;
      const double noise_std = 0.02 * std::exp(spread * rng.Normal());
      for (double& y : fleet.trajectories[s].outputs.reshaped()) y += noise_std * rng.Normal();
    }
    TrainingSpec spec = SmallSpec();
    spec.model.transition.block.hidden_widths = {};
    spec.inner_loop.steps = spec.adaptation.steps = 0;
    spec.iterations = 300;
    spec.validation_share = 0.4;
    spec.context_samples = 100;
    return Train(spec, fleet, nullptr, base::CallingThread(), nullptr)->noise;
  };
  const nssm::FilterNoise alike = found(0), apart = found(1);
  EXPECT_LE(alike.log_std, 0.5);
  EXPECT_LT(alike.own_widening, 0.1);
  EXPECT_GE(apart.log_std, 1);
  EXPECT_GT(apart.own_widening, 0);
}

TEST(TrainTest, FrozenTensorsStayWhereTheyBegin) {
  TrainingSpec spec = SmallSpec();
  const auto trained = [&spec] { return *Train(spec, Fleet(10, 80, 1), nullptr, base::CallingThread(), nullptr); };
  const nssm::Bundle all = trained();
  spec.frozen_mask = "encoder,transition.0.weight";
  const nssm::Bundle some = trained();
  const std::vector<double> start = some.model.InitialParameters(spec.seed);
  for (const nn::Tensor& tensor : some.model.layout().tensors()) {
    const auto values = [&tensor](const std::vector<double>& of) {
      return std::vector<double>(of.begin() + tensor.offset, of.begin() + tensor.offset + tensor.size());
    };
    const bool frozen = tensor.name.starts_with("encoder") || tensor.name == "transition.0.weight";
    EXPECT_EQ(values(some.parameters) == values(start), frozen) << tensor.name;
    EXPECT_NE(values(all.parameters), values(start)) << tensor.name;
  }
  spec.frozen_mask = "engine";
  const absl::StatusOr<nssm::Bundle> wrong = Train(spec, Fleet(10, 80, 1), nullptr, base::CallingThread(), nullptr);
  EXPECT_NE(std::string(wrong.status().message()).find("frozen_mask"), std::string::npos) << wrong.status();
  EXPECT_NE(std::string(wrong.status().message()).find("engine"), std::string::npos) << wrong.status();
}

// A field is a thousandth of its positions, in units of its own: both are of order one inside a model, and so are its gradients.
TEST(TrainTest, AFieldAndItsPositionsHaveScalesOfTheirOwn) {
  Dataset fleet = Fleet(10, 80, 1);
  fleet.output_names = {"y1", "y2"};
  fleet.state_names = {"x1", "x2"};
  for (Trajectory& t : fleet.trajectories) {
    const Eigen::RowVectorXd x = t.states.row(0);
    t.states = Eigen::MatrixXd(2, x.size());
    t.states << 3 * x, 4 * x;
    t.outputs = 1e-3 * t.states;
  }
  TrainingSpec spec = SmallSpec();
  spec.model.curl_free_positions = {0, 1};
  spec.model.output_size = spec.model.state_size = 2;
  spec.iterations = 11;
  const absl::StatusOr<nssm::Bundle> bundle = Train(spec, fleet, nullptr, base::CallingThread(), nullptr);
  ASSERT_TRUE(bundle.ok()) << bundle.status();
  const data::Normaliser& units = bundle->normaliser;
  EXPECT_EQ(units.states.scale[0], units.states.scale[1]);
  EXPECT_EQ(units.outputs.scale[0], units.outputs.scale[1]);
  EXPECT_NEAR(units.outputs.scale[0] / units.states.scale[0], 1e-3, 1e-9);
}

// Only the first samples of a recording tell systems apart, so contexts from anywhere else teach nothing.
TEST(TrainTest, ContextsAtTheStartAreTheFirstSamples) {
  Dataset fleet = Fleet(30, 120, 1);
  for (Trajectory& t : fleet.trajectories) {
    const int64_t silent = t.length() - 40;
    t.inputs.rightCols(silent).setZero();
    t.states.rightCols(silent).setZero();
    t.outputs.rightCols(silent).setZero();
  }
  const auto best_validation_loss = [&](bool at_start) {
    TrainingSpec spec = SmallSpec();
    spec.contexts_at_start = at_start;
    spec.iterations = 300;
    double best = 0;
    EXPECT_TRUE(Train(spec, fleet, nullptr, base::MakeThreadExecutor(2).get(), [&](const TrainingProgress& p) {
                  best = p.state.best_validation_loss;
                  return true;
                }).ok());
    return best;
  };
  EXPECT_LT(best_validation_loss(true), 0.7 * best_validation_loss(false));
}

TEST(TrainTest, AModelOfImplicitMamlIsPulledToItsStartAtAdaptationToo) {
  TrainingSpec spec = SmallSpec();
  spec.algorithm = Algorithm::kImplicitMaml;
  base::Executor* const executor = base::CallingThread();
  const nssm::Bundle bundle = *Train(spec, Fleet(10, 80, 1), nullptr, executor, nullptr);
  const Trajectory system = Fleet(1, 60, 3).trajectories[0];
  AdaptationOptions options = *DefaultAdaptation(bundle);
  const auto distance = [&](double proximal) {
    options.inner_loop.proximal = proximal;
    const std::vector<double> adapted = AdaptedBundle(bundle, system, options)->parameters;
    double squares = 0;
    for (size_t i = 0; i < adapted.size(); ++i) squares += std::pow(adapted[i] - bundle.parameters[i], 2);
    return std::sqrt(squares);
  };
  EXPECT_LT(distance(1e12), 1e-10);
  EXPECT_LT(distance(10), distance(0.1));
}

// The minimum that adaptation goes to is that of descent with the same pull, which takes thousands of steps there.
TEST(TrainTest, AModelOfImplicitMamlByLevenbergMarquardtAdaptsToTheMinimumItWasTrainedWith) {
  TrainingSpec spec = SmallSpec();
  spec.algorithm = Algorithm::kImplicitMaml;
  spec.inner_loop = spec.adaptation = {
      .steps = 30, .adapted_mask = "transition", .optimiser = Optimiser::kLevenbergMarquardt, .proximal = 0.3};
  spec.loss.reconstruction_weight = 0;
  base::Executor* const executor = base::CallingThread();
  const nssm::Bundle bundle = *Train(spec, Fleet(10, 80, 1), nullptr, executor, nullptr);
  const Trajectory system = Fleet(1, 60, 3).trajectories[0];
  const AdaptationOptions options = *DefaultAdaptation(bundle);
  EXPECT_EQ(options.method, AdaptationMethod::kLevenbergMarquardt);
  int told = 0;
  const absl::StatusOr<AdaptationResult> result = Adapt(bundle, system, options, [&](const AdaptationStep&) { return ++told > 0; });
  ASSERT_TRUE(result.ok()) << result.status();
  EXPECT_GT(told, 4);
  EXPECT_LT(result->context_loss_after, result->context_loss_before);
  EXPECT_FALSE(result->posterior);
  AdaptationOptions descent = *DefaultAdaptation(bundle, AdaptationMethod::kGradientDescent);
  descent.inner_loop.steps = 5000;
  descent.inner_loop.learning_rate = 0.05;
  const std::vector<double> there = AdaptedBundle(bundle, system, descent)->parameters;
  double way = 0, apart = 0;
  for (size_t i = 0; i < there.size(); ++i) {
    way += std::pow(there[i] - bundle.parameters[i], 2);
    apart += std::pow(there[i] - result->parameters[i], 2);
  }
  EXPECT_LT(std::sqrt(apart / way), 1e-3);
  const absl::Status stopped = Adapt(bundle, system, options, [](const AdaptationStep&) { return false; }).status();
  EXPECT_EQ(stopped.code(), absl::StatusCode::kCancelled);
}

TEST(TrainTest, ATrainingThatDivergesSaysSoAndLeavesItsLastGoodState) {
  TrainingSpec spec = SmallSpec();
  spec.warmup_iterations = 0;
  spec.iterations = 200;
  spec.outer_lr = spec.final_outer_lr = 1e3;
  base::Executor* const executor = base::CallingThread();
  std::string checkpoint;
  bool diverged = false;
  const auto on_step = [&](const TrainingProgress& p) {
    EXPECT_FALSE(diverged);
    diverged = p.diverged;
    checkpoint = WriteCheckpoint(p.state, "digest");
    return true;
  };
  const absl::Status status = Train(spec, Fleet(10, 80, 1), nullptr, executor, on_step).status();
  ASSERT_EQ(status.code(), absl::StatusCode::kOutOfRange) << status;
  EXPECT_TRUE(diverged);
  for (const char* part : {"diverged at iteration", "loss", "gradient norm", "last good state", "outer_lr (now 1000)"}) {
    EXPECT_NE(std::string(status.message()).find(part), std::string::npos) << status;
  }
  const absl::StatusOr<TrainingState> state = ReadCheckpoint(checkpoint, "digest");
  ASSERT_TRUE(state.ok()) << state.status();
  for (const auto& [name, values] : state->values) {
    EXPECT_TRUE(std::all_of(values.begin(), values.end(), [](double value) { return std::isfinite(value); })) << name;
  }
  // Good: a loss is still a number there, so the training goes on from it, to the same end.
  const absl::Status again = Train(spec, Fleet(10, 80, 1), &*state, executor, nullptr).status();
  EXPECT_EQ(again, status);
}

TEST(TrainTest, ACheckpointOfAnotherTrainingIsRefused) {
  const std::string checkpoint = WriteCheckpoint({.iteration = 3, .values = {{"parameters", {1, 2}}}}, "a");
  EXPECT_EQ(ReadCheckpoint(checkpoint, "a")->values.at("parameters"), (std::vector<double>{1, 2}));
  EXPECT_EQ(ReadCheckpoint(checkpoint, "b").status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_FALSE(ReadCheckpoint(checkpoint.substr(0, checkpoint.size() - 3), "a").ok());
}

TEST(TrainTest, AdaptingToAnUnseenSystemBeatsTheMetaLearnedModel) {
  TrainingSpec spec = SmallSpec();
  spec.iterations = 500;
  spec.warmup_iterations = 300;
  const auto executor = base::MakeThreadExecutor(2);
  const absl::StatusOr<nssm::Bundle> bundle = Train(spec, Fleet(20, 120, 1), nullptr, executor.get(), nullptr);
  ASSERT_TRUE(bundle.ok()) << bundle.status();
  const Dataset unseen = Fleet(12, 100, 77);
  int better = 0;
  for (const Trajectory& system : unseen.trajectories) {
    const absl::StatusOr<AdaptationResult> result =
        Adapt(*bundle, system, {.inner_loop = {.steps = 50, .learning_rate = 0.02, .adapted_mask = "transition"}}, nullptr);
    ASSERT_TRUE(result.ok()) << result.status();
    EXPECT_LT(result->context_loss_after, result->context_loss_before);
    EXPECT_LT(result->arx.one_step[0], 1e-9);  // the system is an ARX model without noise
    better += result->after.simulate[0] < result->before.simulate[0] ? 1 : 0;
  }
  EXPECT_GE(better, 10);
}

TEST(TrainTest, WhatDoesNotFitIsRefusedByName) {
  base::Executor* const executor = base::CallingThread();
  const auto message = [&](const TrainingSpec& spec, const Dataset& fleet) {
    return std::string(Train(spec, fleet, nullptr, executor, nullptr).status().message());
  };
  Dataset fleet = Fleet(5, 80, 1);
  TrainingSpec spec = SmallSpec();
  spec.target_samples = 81;
  EXPECT_NE(message(spec, fleet).find("trajectory 0: 80 samples"), std::string::npos);
  spec = SmallSpec();
  spec.model.output_size = 2;
  EXPECT_NE(message(spec, fleet).find("model.output_size is 2, the data has 1"), std::string::npos);
  spec = SmallSpec();
  spec.inner_loop.adapted_mask = "enconder";
  EXPECT_NE(message(spec, fleet).find("\"enconder\" matches no parameter"), std::string::npos);
  spec = SmallSpec();
  spec.inner_loop = {.steps = 100, .learning_rate = 1e6};
  spec.warmup_iterations = 0;
  EXPECT_NE(message(spec, fleet).find("diverged at iteration"), std::string::npos);
  fleet.trajectories[3].sample_period_s = 0.2;
  EXPECT_NE(message(SmallSpec(), fleet).find("trajectory 3"), std::string::npos);
  fleet.state_names.clear();
  EXPECT_NE(message(SmallSpec(), fleet).find("state columns"), std::string::npos);
}

}  // namespace
}  // namespace metaekf::meta
