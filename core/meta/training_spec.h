#pragma once

#include <map>
#include <nlohmann/json_fwd.hpp>
#include <string>

#include "absl/status/statusor.h"
#include "core/nssm/spec.h"

namespace metaekf::meta {

enum class Algorithm { kMaml, kFirstOrderMaml, kSupervised, kGaussianPrior, kReptile, kImplicitMaml, kMixedEffects };

enum class Optimiser { kGradientDescent, kAdam, kLevenbergMarquardt };

inline constexpr double kSmallestRate = 1e-12, kLargestRate = 1e6;  // of an inner step

/// The inner loop, in training or at adaptation: the message InnerLoopSpec of spec.proto.
struct InnerLoopSpec {
  int32_t steps = 10;
  double learning_rate = 0.01;
  std::string adapted_mask = "*";
  Optimiser optimiser = Optimiser::kGradientDescent;
  double proximal = 1;  ///< λ of kImplicitMaml and kMixedEffects, and of kLevenbergMarquardt where no prior has been learned
  bool learned_rates = false;
  bool curvature_rates = false;
  std::map<std::string, double> tensor_rates;  ///< by the tensor's name; the others' is learning_rate
};

enum class PriorCovariance { kFull, kLowRank, kBlock, kManifold };

/// Empirical Bayes: the message GaussianPriorSpec of spec.proto.
struct GaussianPriorSpec {
  int32_t meta_iterations = 0;
  Algorithm meta_algorithm = Algorithm::kMaml;  ///< or kMixedEffects
  double initial_std = 0.1;
  int32_t rounds = 6;
  int32_t restarts = 6;
  int32_t first_steps = 60;
  int32_t round_steps = 10;
  PriorCovariance covariance = PriorCovariance::kFull;
  int32_t rank = 0;  ///< R of kLowRank and kManifold, else 0
};

/// The message ImplicitMamlSpec of spec.proto.
struct ImplicitMamlSpec {
  int32_t cg_steps = 10;
  double cg_tolerance = 1e-6;
};

/// How a model is meta-trained: the message TrainingSpec of spec.proto, where each field is described.
struct TrainingSpec {
  nssm::ModelSpec model;
  nssm::LossSpec loss;
  Algorithm algorithm = Algorithm::kMaml;
  InnerLoopSpec inner_loop;
  InnerLoopSpec adaptation;
  GaussianPriorSpec gaussian_prior;
  ImplicitMamlSpec implicit_maml;
  int32_t context_samples = 100;
  int32_t target_samples = 100;
  bool contexts_at_start = false;
  bool linear_start = false;
  std::string frozen_mask;  ///< empty: nothing
  int32_t task_batch = 8;
  int32_t iterations = 1000;
  int32_t restarts = 1;
  int32_t screening_iterations = 0;
  int32_t warmup_iterations = 0;
  int32_t warmup_horizon = 10;
  int32_t horizon_growth_iterations = 0;
  double warmup_lr = 1e-3;
  double outer_lr = 1e-3;
  double final_outer_lr = 1e-3;
  double clip_norm = 10;
  double validation_share = 0.2;
  int32_t validation_period = 25;
  uint64_t seed = 0;
  double sample_period_s = 0;  ///< 0: the data's
};

/// Reads the JSON form of the message. Errors: InvalidArgument naming the field and what is wrong with it.
absl::StatusOr<TrainingSpec> ReadTrainingSpec(const nlohmann::json& object);

/// The inverse: every field spelled out.
nlohmann::json ToJson(const TrainingSpec& spec);

}  // namespace metaekf::meta
