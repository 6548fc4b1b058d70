#include "core/experiments/bouc_wen_learners.h"

#include <algorithm>
#include <nlohmann/json.hpp>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/meta/adapt.h"
#include "core/meta/fit_plan.h"
#include "core/meta/scratch_fit.h"

namespace metaekf::experiments {
namespace {

using nlohmann::json;

constexpr int32_t kScratchSteps = 1000;  // of a gradient-based fit at most

/// The recipe of deploy/specs/bouc-wen.textproto, a round less: fits in free run over whole recordings, starts fitted, no encoder.
constexpr char kGaussianPrior[] = R"json({
  "algorithm": "GAUSSIAN_PRIOR",
  "model": {
    "case": "INPUT_OUTPUT", "latent_size": 5, "window": 40, "start": "FITTED", "precision": "FLOAT64",
    "transition": {"form": "JOINT", "bypass": "LINEAR", "input_time": "NEXT",
                   "block": {"hidden_widths": [16], "activation": "TANH", "output_scale": 0.1}}
  },
  "loss": {"whole_set_horizon": true},
  "gaussian_prior": {"initial_std": 0.1, "restarts": 4, "first_steps": 60, "round_steps": 15, "rounds": 2},
  "context_samples": 500, "target_samples": 2000, "validation_share": 0.1
})json";

/// The gradient-based learners, after deploy/specs/bouc-wen-maml.textproto in half its iterations: the same transition behind a
/// linear encoder of 40 samples. λ of iMAML is 1/(steps · learning_rate), where five steps do end near the minimum that its
/// gradient is of: with less the training diverged.
constexpr char kGradientBased[] = R"json({
  "model": {
    "case": "INPUT_OUTPUT", "latent_size": 6, "window": 40, "precision": "FLOAT64",
    "transition": {"form": "JOINT", "bypass": "LINEAR", "input_time": "NEXT",
                   "block": {"hidden_widths": [16], "activation": "TANH", "output_scale": 0.1}}
  },
  "loss": {"horizon": 20, "stride": 10},
  "inner_loop": {"steps": 5, "learning_rate": 1e-4, "proximal": 2000},
  "adaptation": {"steps": 300, "learning_rate": 1e-3, "optimiser": "ADAM"},
  "context_samples": 512, "target_samples": 512, "task_batch": 8, "clip_norm": 1, "validation_period": 50,
  "iterations": 4600, "warmup_iterations": 4000, "warmup_horizon": 20,
  "warmup_lr": 0.01, "outer_lr": 0.001, "final_outer_lr": 1e-4
})json";

struct Variant {
  const char* label;
  const char* common;
  const char* changes;
};

constexpr Variant kVariants[] = {
    {"Gaussian prior", kGaussianPrior, "{}"},
    {"MAML", kGradientBased, R"json({"algorithm": "MAML"})json"},
    {"FO-MAML", kGradientBased, R"json({"algorithm": "FIRST_ORDER_MAML"})json"},
    {"ANIL", kGradientBased, R"json({"algorithm": "MAML", "inner_loop": {"adapted_mask": "transition,output_decoder"}})json"},
    {"Reptile", kGradientBased, R"json({"algorithm": "REPTILE"})json"},
    {"iMAML", kGradientBased, R"json({"algorithm": "IMPLICIT_MAML"})json"},
    {"Xfer", kGradientBased, R"json({"algorithm": "SUPERVISED"})json"},
};

/// Some minutes for all learners together: fewer steps of everything, for the order of things.
constexpr char kQuick[] = R"json({
  "iterations": 500, "warmup_iterations": 400,
  "gaussian_prior": {"restarts": 3, "first_steps": 40, "round_steps": 10, "rounds": 1}
})json";

/// For tests: seconds, and nothing is learned.
constexpr char kTiny[] = R"json({
  "iterations": 6, "warmup_iterations": 3, "context_samples": 120, "target_samples": 120,
  "gaussian_prior": {"restarts": 1, "rounds": 1, "first_steps": 4, "round_steps": 2}
})json";

/// paper.tex section bw_example: H = 20, ELU, n_ψ = 16, both learning rates 1e-3, M = 40. Horizon and sets are ours.
constexpr char kPrinted[] = R"json({
  "algorithm": "MAML",
  "model": {
    "case": "INPUT_OUTPUT", "latent_size": 16, "window": 20,
    "encoder": {"hidden_widths": [256, 128, 128, 64, 64, 32, 32], "activation": "ELU"},
    "transition": {"form": "JOINT", "block": {"hidden_widths": [256, 256, 256, 256, 256], "activation": "ELU"}},
    "output_decoder": {"hidden_widths": [32, 32, 64, 64, 128, 128, 256], "activation": "ELU"}
  },
  "loss": {"horizon": 20, "stride": 100},
  "inner_loop": {"steps": 5, "learning_rate": 1e-3},
  "adaptation": {"steps": 40},
  "context_samples": 500, "target_samples": 500, "task_batch": 2, "clip_norm": 1, "validation_period": 100,
  "iterations": 320, "warmup_iterations": 300, "warmup_lr": 1e-3, "outer_lr": 1e-3, "final_outer_lr": 1e-4
})json";

}  // namespace

Learner PrintedMaml(Budget budget) {
  Learner learner{.data = TrainingData::kFleet, .specification = json::parse(kPrinted)};
  if (budget == Budget::kQuick) learner.specification.merge_patch({{"iterations", 40}, {"warmup_iterations", 35}});
  if (budget == Budget::kTiny) {
    learner.specification.merge_patch(json::parse(kTiny));
    learner.specification.merge_patch(json::parse(R"json({"adaptation": {"steps": 2}, "inner_loop": {"steps": 1}})json"));
  }
  learner.label = absl::StrCat("MAML, printed network, ", learner.specification["iterations"].get<int>(), " iterations");
  return learner;
}

std::vector<Learner> BoucWenLearners(Budget budget) {
  std::vector<Learner> learners;
  for (const Variant& variant : kVariants) {
    Learner learner{variant.label, TrainingData::kFleet, json::parse(variant.common)};
    learner.specification.merge_patch(json::parse(variant.changes));
    if (budget == Budget::kQuick) learner.specification.merge_patch(json::parse(kQuick));
    if (budget == Budget::kTiny) {
      learner.specification.merge_patch(json::parse(kTiny));
      learner.specification["adaptation"]["steps"] = 5;
    }
    learners.push_back(std::move(learner));
  }
  return learners;
}

absl::StatusOr<SystemModel> FitFromScratch(const Learner& like, const data::Trajectory& context, uint64_t seed) {
  METAEKF_ASSIGN_OR_RETURN(meta::TrainingSpec spec, meta::ReadTrainingSpec(like.specification));
  spec.model.input_size = spec.model.output_size = 1;
  spec.model.state_size = 0;
  METAEKF_ASSIGN_OR_RETURN(nssm::Model model, nssm::Model::Create(spec.model));
  const data::Dataset alone{.input_names = {"u1"}, .output_names = {"y1"}, .trajectories = {context}};
  METAEKF_ASSIGN_OR_RETURN(const data::Normaliser normaliser, data::FitNormaliser(alone, {}));
  nssm::Bundle bundle{.model = std::move(model), .normaliser = normaliser, .sample_period_s = context.sample_period_s,
                      .names = {alone.input_names, alone.output_names, {}}, .training = meta::ToJson(spec)};
  if (spec.model.fits_start()) {
    METAEKF_ASSIGN_OR_RETURN(const data::Trajectory normalised, data::Normalised(normaliser, context));
    const meta::FitPlan plan(bundle.model, spec.loss, nn::Mask(bundle.model.layout().tensors().size(), true));
    METAEKF_ASSIGN_OR_RETURN(meta::SystemFit fit,
                             meta::FitFromScratch(plan, bundle.model, spec.loss, normalised,
                                                  {.seed = seed, .steps = spec.adaptation.steps, .stop_early = true}, nullptr));
    bundle.parameters = std::move(fit.parameters);
    const Eigen::Index latents = spec.model.latent_size;  // of the order of one; where they begin is not known
    bundle.prior = nssm::GaussianPrior{.start = Eigen::MatrixXd::Identity(latents, latents),
                                       .start_guess = Eigen::MatrixXd::Zero(latents, bundle.model.start_size() + 1),
                                       .noise_variance = fit.fit.noise_variance};
    return ModelOf(bundle);
  }
  bundle.parameters = bundle.model.InitialParameters(seed);
  METAEKF_ASSIGN_OR_RETURN(meta::AdaptationOptions options,
                           meta::DefaultAdaptation(bundle, meta::AdaptationMethod::kFromScratch));
  options.seed = seed;
  options.inner_loop.steps = std::min(options.inner_loop.steps, kScratchSteps);
  METAEKF_ASSIGN_OR_RETURN(meta::AdaptationResult result, meta::Adapt(bundle, context, options, nullptr));
  bundle.parameters = std::move(result.parameters);
  return ModelOf(bundle);
}

}  // namespace metaekf::experiments
