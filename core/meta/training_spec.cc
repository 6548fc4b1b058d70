#include "core/meta/training_spec.h"

#include <nlohmann/json.hpp>

#include "core/base/status.h"
#include "core/meta/linear_state_start.h"

namespace metaekf::meta {
namespace {

using base::JsonFields;
using nlohmann::json;

const std::vector<std::pair<std::string, Algorithm>> kAlgorithms = {
    {"MAML", Algorithm::kMaml}, {"FIRST_ORDER_MAML", Algorithm::kFirstOrderMaml}, {"SUPERVISED", Algorithm::kSupervised},
    {"GAUSSIAN_PRIOR", Algorithm::kGaussianPrior}, {"REPTILE", Algorithm::kReptile},
    {"IMPLICIT_MAML", Algorithm::kImplicitMaml}, {"MIXED_EFFECTS", Algorithm::kMixedEffects}};

const std::vector<std::pair<std::string, Optimiser>> kOptimisers = {{"GRADIENT_DESCENT", Optimiser::kGradientDescent},
                                                                    {"ADAM", Optimiser::kAdam},
                                                                    {"LEVENBERG_MARQUARDT", Optimiser::kLevenbergMarquardt}};

const std::vector<std::pair<std::string, PriorCovariance>> kPriorCovariances = {{"FULL", PriorCovariance::kFull},
                                                                                {"LOW_RANK", PriorCovariance::kLowRank},
                                                                                {"BLOCK", PriorCovariance::kBlock},
                                                                                {"MANIFOLD", PriorCovariance::kManifold}};

constexpr int32_t kGaussianPriorSteps = 60;  // of Levenberg–Marquardt at adaptation

constexpr int32_t kMany = 100'000'000;

template <typename Enum>
std::string NameOf(const std::vector<std::pair<std::string, Enum>>& names, Enum value) {
  for (const auto& [name, candidate] : names) {
    if (candidate == value) return name;
  }
  return "";
}

InnerLoopSpec ReadInnerLoop(JsonFields* parent, const std::string& name, InnerLoopSpec spec) {
  JsonFields fields = parent->Object(name);
  spec.steps = static_cast<int32_t>(fields.Integer("steps", spec.steps, 0, 1'000'000));
  spec.learning_rate = fields.Number("learning_rate", spec.learning_rate, 0, kLargestRate);
  spec.adapted_mask = fields.String("adapted_mask", spec.adapted_mask);
  const Optimiser default_optimiser = spec.optimiser;
  spec.optimiser = fields.Choice("optimiser", spec.optimiser, kOptimisers);
  if (spec.optimiser != default_optimiser) {
    // The rates of one optimiser are nothing to another.
    spec.learned_rates = spec.curvature_rates = false;
    spec.tensor_rates.clear();
  }
  spec.proximal = fields.Number("proximal", spec.proximal, 0, 1e12);
  spec.learned_rates = fields.Bool("learned_rates", spec.learned_rates);
  spec.curvature_rates = fields.Bool("curvature_rates", spec.curvature_rates);
  if (fields.Has("tensor_rates")) spec.tensor_rates = fields.NumbersByName("tensor_rates", kSmallestRate, kLargestRate);
  parent->Include(fields.Finish());
  return spec;
}

json InnerLoopJson(const InnerLoopSpec& spec) {
  return {{"steps", spec.steps},
          {"learning_rate", spec.learning_rate},
          {"adapted_mask", spec.adapted_mask},
          {"optimiser", NameOf(kOptimisers, spec.optimiser)},
          {"proximal", spec.proximal},
          {"learned_rates", spec.learned_rates},
          {"curvature_rates", spec.curvature_rates},
          {"tensor_rates", spec.tensor_rates}};
}

GaussianPriorSpec ReadGaussianPrior(JsonFields* parent) {
  GaussianPriorSpec spec;
  JsonFields fields = parent->Object("gaussian_prior");
  const auto positive = [&fields](const std::string& name, int32_t default_value) {
    const int32_t value = static_cast<int32_t>(fields.Integer(name, default_value, 0, kMany));
    return value == 0 ? default_value : value;
  };
  spec.meta_iterations = static_cast<int32_t>(fields.Integer("meta_iterations", 0, 0, kMany));
  spec.meta_algorithm = fields.Choice("meta_algorithm", spec.meta_algorithm, kAlgorithms);
  if (spec.meta_algorithm != Algorithm::kMaml && spec.meta_algorithm != Algorithm::kMixedEffects) {
    fields.Fail("meta_algorithm", absl::StrCat("is MAML or MIXED_EFFECTS, not ", NameOf(kAlgorithms, spec.meta_algorithm)));
  }
  spec.initial_std = fields.Number("initial_std", spec.initial_std, 1e-9, 1e9);
  spec.rounds = positive("rounds", spec.rounds);
  spec.restarts = positive("restarts", spec.restarts);
  spec.first_steps = positive("first_steps", spec.first_steps);
  spec.round_steps = positive("round_steps", spec.round_steps);
  spec.covariance = fields.Choice("covariance", spec.covariance, kPriorCovariances);
  spec.rank = positive("rank", spec.rank);
  const bool has_factors = spec.covariance == PriorCovariance::kLowRank || spec.covariance == PriorCovariance::kManifold;
  if (has_factors && spec.rank == 0) {
    fields.Fail("rank", absl::StrCat(NameOf(kPriorCovariances, spec.covariance), " needs the number of its factors, 1 at least"));
  }
  if (!has_factors && spec.rank > 0) {
    fields.Fail("rank", absl::StrCat("is that of LOW_RANK and MANIFOLD; the covariance is ", NameOf(kPriorCovariances, spec.covariance)));
  }
  parent->Include(fields.Finish());
  return spec;
}

ImplicitMamlSpec ReadImplicitMaml(JsonFields* parent) {
  ImplicitMamlSpec spec;
  JsonFields fields = parent->Object("implicit_maml");
  const int32_t steps = static_cast<int32_t>(fields.Integer("cg_steps", spec.cg_steps, 0, 1'000'000));
  if (steps > 0) spec.cg_steps = steps;
  spec.cg_tolerance = fields.Number("cg_tolerance", spec.cg_tolerance, 0, 1);
  parent->Include(fields.Finish());
  return spec;
}

/// What the algorithms ask of their inner loop.
void CheckInnerLoop(const TrainingSpec& spec, JsonFields* fields) {
  const InnerLoopSpec& inner = spec.inner_loop;
  if (inner.optimiser == Optimiser::kLevenbergMarquardt) {
    if (spec.algorithm != Algorithm::kImplicitMaml) {
      fields->Fail("inner_loop.optimiser",
                   "LEVENBERG_MARQUARDT is for IMPLICIT_MAML and for adaptation; its steps are not differentiated");
    } else if (spec.loss.reconstruction_weight > 0) {
      fields->Fail("loss.reconstruction_weight",
                   "must be 0 with inner_loop.optimiser LEVENBERG_MARQUARDT, which fits rollouts alone");
    }
  }
  const bool by_maml = spec.algorithm == Algorithm::kMaml || spec.algorithm == Algorithm::kFirstOrderMaml ||
                       (spec.algorithm == Algorithm::kGaussianPrior && spec.gaussian_prior.meta_iterations > 0 &&
                        spec.gaussian_prior.meta_algorithm == Algorithm::kMaml);
  if (inner.learned_rates && !by_maml) {
    fields->Fail("inner_loop.learned_rates", "only MAML and FIRST_ORDER_MAML have a gradient for the rates");
  }
  if (inner.learned_rates && inner.learning_rate < kSmallestRate) {
    fields->Fail("inner_loop.learning_rate", "learned rates begin with it, so it must be positive");
  }
  if (inner.curvature_rates && (!inner.learned_rates || inner.optimiser != Optimiser::kGradientDescent)) {
    fields->Fail("inner_loop.curvature_rates", "is where learned_rates of GRADIENT_DESCENT begin, and nothing without them");
  }
  if (spec.algorithm == Algorithm::kReptile && inner.steps == 0) {
    fields->Fail("inner_loop.steps", "REPTILE learns from the inner steps and needs one at least");
  }
  if (spec.algorithm == Algorithm::kImplicitMaml && inner.proximal == 0) {
    fields->Fail("inner_loop.proximal", "must be positive for IMPLICIT_MAML");
  }
}

/// Steps of the outer loop, if there are any.
int32_t OuterIterations(const TrainingSpec& spec) {
  return spec.algorithm == Algorithm::kGaussianPrior ? spec.gaussian_prior.meta_iterations : spec.iterations;
}

/// Whether there is room for rollouts to grow in.
void CheckHorizonGrowth(const TrainingSpec& spec, JsonFields* fields) {
  if (spec.horizon_growth_iterations == 0) return;
  const int32_t iterations = OuterIterations(spec) - spec.warmup_iterations;
  if (OuterIterations(spec) == 0) {
    fields->Fail("horizon_growth_iterations", "GAUSSIAN_PRIOR without meta_iterations has none; its first fits grow their rollouts by themselves");
  } else if (spec.horizon_growth_iterations >= iterations) {
    fields->Fail("horizon_growth_iterations", absl::StrCat("must leave some of the ", iterations,
                                                           " iterations after the warm-up for rollouts of full length"));
  }
}

/// Rates at the inverse curvature are found when the warm-up ends.
void CheckCurvatureRates(const TrainingSpec& spec, JsonFields* fields) {
  const int32_t iterations = OuterIterations(spec);
  if (!spec.inner_loop.curvature_rates || spec.warmup_iterations < iterations) return;
  fields->Fail("warmup_iterations", absl::StrCat("must be less than the ", iterations,
                                                 " iterations if there are curvature_rates, which begin after the warm-up"));
}

/// Whether the model has the form of one that starts linear.
void CheckLinearStart(const TrainingSpec& spec, JsonFields* fields) {
  if (!spec.linear_start) return;
  const absl::Status status = CheckLinearStateStart(spec.model);
  if (!status.ok()) fields->Fail("linear_start", std::string(status.message()));
  if (spec.algorithm == Algorithm::kGaussianPrior && spec.gaussian_prior.meta_iterations == 0) {
    fields->Fail("linear_start", "GAUSSIAN_PRIOR needs gaussian_prior.meta_iterations that begin there");
  }
}

/// Whether there is something to choose among several starts by.
void CheckRestarts(const TrainingSpec& spec, JsonFields* fields) {
  if (spec.restarts == 1) return;
  if (spec.algorithm == Algorithm::kGaussianPrior) fields->Fail("restarts", "GAUSSIAN_PRIOR has gaussian_prior.restarts");
  if (spec.algorithm == Algorithm::kMixedEffects) fields->Fail("restarts", "MIXED_EFFECTS judges nothing, so it cannot choose among starts");
  if (spec.screening_iterations == 0 || spec.screening_iterations > spec.iterations) {
    fields->Fail("screening_iterations", absl::StrCat("must be from 1 to the ", spec.iterations, " iterations if there are restarts"));
  }
  if (spec.inner_loop.curvature_rates && spec.screening_iterations <= spec.warmup_iterations) {
    fields->Fail("screening_iterations", "must be more than warmup_iterations if there are restarts and curvature_rates: starts cannot be compared before");
  }
  if (spec.validation_share == 0) fields->Fail("validation_share", "must be positive if there are restarts to choose among");
}

}  // namespace

absl::StatusOr<TrainingSpec> ReadTrainingSpec(const json& object) {
  JsonFields fields(object, "");
  TrainingSpec spec;
  METAEKF_ASSIGN_OR_RETURN(spec.model, nssm::ReadModelSpec(fields.Object("model")));
  METAEKF_ASSIGN_OR_RETURN(spec.loss, nssm::ReadLossSpec(fields.Object("loss"), spec.model));
  spec.algorithm = fields.Choice("algorithm", Algorithm::kMaml, kAlgorithms);
  spec.inner_loop = ReadInnerLoop(&fields, "inner_loop", InnerLoopSpec());
  spec.gaussian_prior = ReadGaussianPrior(&fields);
  CheckInnerLoop(spec, &fields);
  if (spec.gaussian_prior.meta_iterations > 0 && spec.model.fits_start()) {
    fields.Fail("gaussian_prior.meta_iterations", "must be 0 for a model whose start is FITTED, which MAML does not train");
  }
  spec.implicit_maml = ReadImplicitMaml(&fields);
  InnerLoopSpec adaptation = spec.inner_loop;
  if (spec.algorithm == Algorithm::kGaussianPrior) {
    adaptation.optimiser = Optimiser::kLevenbergMarquardt;
    adaptation.steps = kGaussianPriorSteps;
  }
  spec.adaptation = ReadInnerLoop(&fields, "adaptation", adaptation);
  if (spec.algorithm == Algorithm::kGaussianPrior && spec.gaussian_prior.meta_iterations > 0 &&
      spec.gaussian_prior.meta_algorithm == Algorithm::kMixedEffects && spec.adaptation.adapted_mask != spec.inner_loop.adapted_mask) {
    fields.Fail("adaptation.adapted_mask", absl::StrCat("is \"", spec.adaptation.adapted_mask, "\", but the prior begins with what MIXED_EFFECTS finds for inner_loop.adapted_mask, \"",
                                                        spec.inner_loop.adapted_mask, "\": they must be the same"));
  }
  const auto positive = [&fields](const std::string& name, int32_t default_value) {
    const int32_t value = static_cast<int32_t>(fields.Integer(name, default_value, 0, kMany));
    return value == 0 ? default_value : value;
  };
  spec.context_samples = positive("context_samples", spec.context_samples);
  spec.target_samples = positive("target_samples", spec.target_samples);
  spec.contexts_at_start = fields.Bool("contexts_at_start", spec.contexts_at_start);
  spec.linear_start = fields.Bool("linear_start", spec.linear_start);
  CheckLinearStart(spec, &fields);
  spec.frozen_mask = fields.String("frozen_mask", spec.frozen_mask);
  spec.task_batch = positive("task_batch", spec.task_batch);
  spec.iterations = positive("iterations", spec.iterations);
  spec.restarts = positive("restarts", spec.restarts);
  spec.screening_iterations = static_cast<int32_t>(fields.Integer("screening_iterations", 0, 0, kMany));
  spec.warmup_iterations = static_cast<int32_t>(fields.Integer("warmup_iterations", 0, 0, kMany));
  spec.warmup_horizon = positive("warmup_horizon", spec.warmup_horizon);
  spec.horizon_growth_iterations = static_cast<int32_t>(fields.Integer("horizon_growth_iterations", 0, 0, kMany));
  CheckHorizonGrowth(spec, &fields);
  CheckCurvatureRates(spec, &fields);
  spec.outer_lr = fields.Number("outer_lr", spec.outer_lr, 0, 1e3);
  spec.warmup_lr = fields.Number("warmup_lr", spec.outer_lr, 0, 1e3);
  spec.final_outer_lr = fields.Number("final_outer_lr", spec.outer_lr, 0, 1e3);
  spec.clip_norm = fields.Number("clip_norm", spec.clip_norm, 0, 1e12);
  spec.validation_share = fields.Number("validation_share", spec.validation_share, 0, 0.9);
  spec.validation_period = positive("validation_period", spec.validation_period);
  CheckRestarts(spec, &fields);
  spec.seed = static_cast<uint64_t>(fields.Integer("seed", 0, 0, INT64_MAX));
  spec.sample_period_s = fields.Number("sample_period_s", 0, 0, 1e9);
  METAEKF_RETURN_IF_ERROR(fields.Finish());
  return spec;
}

json ToJson(const TrainingSpec& spec) {
  return {{"model", nssm::ToJson(spec.model)},
          {"loss", nssm::ToJson(spec.loss)},
          {"algorithm", NameOf(kAlgorithms, spec.algorithm)},
          {"inner_loop", InnerLoopJson(spec.inner_loop)},
          {"adaptation", InnerLoopJson(spec.adaptation)},
          {"gaussian_prior",
           {{"meta_iterations", spec.gaussian_prior.meta_iterations},
            {"meta_algorithm", NameOf(kAlgorithms, spec.gaussian_prior.meta_algorithm)},
            {"initial_std", spec.gaussian_prior.initial_std},
            {"rounds", spec.gaussian_prior.rounds},
            {"restarts", spec.gaussian_prior.restarts},
            {"first_steps", spec.gaussian_prior.first_steps},
            {"round_steps", spec.gaussian_prior.round_steps},
            {"covariance", NameOf(kPriorCovariances, spec.gaussian_prior.covariance)},
            {"rank", spec.gaussian_prior.rank}}},
          {"implicit_maml", {{"cg_steps", spec.implicit_maml.cg_steps}, {"cg_tolerance", spec.implicit_maml.cg_tolerance}}},
          {"context_samples", spec.context_samples},
          {"target_samples", spec.target_samples},
          {"contexts_at_start", spec.contexts_at_start},
          {"linear_start", spec.linear_start},
          {"frozen_mask", spec.frozen_mask},
          {"task_batch", spec.task_batch},
          {"iterations", spec.iterations},
          {"restarts", spec.restarts},
          {"screening_iterations", spec.screening_iterations},
          {"warmup_iterations", spec.warmup_iterations},
          {"warmup_horizon", spec.warmup_horizon},
          {"horizon_growth_iterations", spec.horizon_growth_iterations},
          {"warmup_lr", spec.warmup_lr},
          {"outer_lr", spec.outer_lr},
          {"final_outer_lr", spec.final_outer_lr},
          {"clip_norm", spec.clip_norm},
          {"validation_share", spec.validation_share},
          {"validation_period", spec.validation_period},
          {"seed", spec.seed},
          {"sample_period_s", spec.sample_period_s}};
}

}  // namespace metaekf::meta
