#include "core/experiments/vapor_compression_learners.h"

#include <nlohmann/json.hpp>

#include "absl/strings/str_cat.h"
#include "core/sim/vapor_compression.h"

namespace metaekf::experiments {
namespace {

using nlohmann::json;

/// What all have. States are measured in training and context; the linear start is in the fleet's principal coordinates. The network
/// learns from rollouts of five steps at first, then of twenty: from single ones it learns nothing of how errors go on, and the filter
/// lives on that. The reconstruction's weight keeps the autoencoder exact enough to project by.
constexpr char kCommon[] = R"json({
  "model": {
    "case": "STATE_INPUT_OUTPUT", "latent_size": 26, "precision": "FLOAT32",
    "transition": {"form": "AUTONOMOUS", "bypass": "LINEAR", "increment_scale": 0.05,
                   "block": {"hidden_widths": [64, 64, 32], "activation": "SWISH"}}
  },
  "loss": {"horizon": 20, "stride": 20, "rollout": "STATE", "state_weight": 300, "reconstruction_weight": 100},
  "linear_start": true, "context_samples": 200, "target_samples": 400, "contexts_at_start": true, "validation_share": 0.1,
  "clip_norm": 2, "validation_period": 100, "warmup_horizon": 5, "final_outer_lr": 1e-5
})json";

/// An offset of the latents for every system, along two directions in the end: what one length of pipe or another does. Two latents
/// more than states and inputs have hold what these do not tell.
constexpr char kPrior[] = R"json({
  "algorithm": "GAUSSIAN_PRIOR", "task_batch": 8, "model": {"latent_size": 28}, "outer_lr": 0.001, "horizon_growth_iterations": 36000,
  "inner_loop": {"steps": 1, "adapted_mask": "encoder.0.bias", "proximal": 0.001},
  "gaussian_prior": {"meta_iterations": 48000, "meta_algorithm": "MIXED_EFFECTS", "covariance": "MANIFOLD", "rank": 2, "rounds": 1,
                     "first_steps": 6, "round_steps": 4},
  "adaptation": {"steps": 20}
})json";

constexpr char kMaml[] = R"json({
  "algorithm": "MAML", "task_batch": 4, "iterations": 27000, "warmup_iterations": 24000, "horizon_growth_iterations": 1000,
  "warmup_lr": 0.001, "outer_lr": 0.0003,
  "inner_loop": {"steps": 10, "learning_rate": 0.5, "learned_rates": true, "curvature_rates": true, "adapted_mask": "transition.3.weight"},
  "adaptation": {"steps": 10}
})json";

constexpr char kUniversal[] = R"json({
  "algorithm": "SUPERVISED", "task_batch": 8, "iterations": 48000, "horizon_growth_iterations": 36000, "outer_lr": 0.001,
  "inner_loop": {"steps": 1}, "adaptation": {"steps": 0}
})json";

/// Of a quick study.
constexpr char kShortPrior[] = R"json({"horizon_growth_iterations": 3500, "gaussian_prior": {"meta_iterations": 5000}})json";
constexpr char kShortMaml[] = R"json({"iterations": 4900, "warmup_iterations": 4500, "horizon_growth_iterations": 150})json";
constexpr char kShortUniversal[] = R"json({"iterations": 5000, "horizon_growth_iterations": 3500})json";
/// To see that everything runs.
constexpr char kTiny[] = R"json({
  "iterations": 8, "horizon_growth_iterations": 2, "task_batch": 2, "target_samples": 60, "context_samples": 60,
  "validation_period": 4, "validation_share": 0.2
})json";
constexpr char kTinyMaml[] = R"json({"warmup_iterations": 4})json";
constexpr char kTinyPrior[] = R"json({"gaussian_prior": {"meta_iterations": 8, "first_steps": 2, "round_steps": 2}, "adaptation": {"steps": 2}})json";

json Merged(json a, const json& b) {
  a.merge_patch(b);
  return a;
}

json Parsed(const char* text) { return json::parse(text); }

}  // namespace

std::string Unconstrained(const std::string& label) { return absl::StrCat(label, ", unconstrained"); }

std::map<std::string, std::string> VaporCompressionSettings() {
  return {{"hold_s", "5"}, {"pressure_noise_std", "1000"}, {"temperature_noise_std", "0.1"}};
}

std::vector<double> PressureOrder() {
  constexpr int kVolumes = sim::kVaporCompressionVolumes, kStates = 3 * kVolumes;
  std::vector<double> matrix(static_cast<size_t>((kVolumes - 1) * kStates), 0.0);
  for (int i = 0; i + 1 < kVolumes; ++i) {
    matrix[static_cast<size_t>(i * kStates + i)] = -1;
    matrix[static_cast<size_t>(i * kStates + i + 1)] = 1;
  }
  return matrix;
}

std::vector<Learner> VaporCompressionLearners(Budget budget) {
  // The layer begins as the identity up to its edge; what it could learn the decoder learns, too.
  const json order = {{"model", {{"state_constraint", {{"polyhedron", {{"matrix", PressureOrder()}}}}}}}, {"frozen_mask", "state_constraint"}};
  const auto recipe = [budget](const char* own, const char* quick, const char* tiny) {
    json merged = Merged(Parsed(kCommon), Parsed(own));
    if (budget == Budget::kQuick) return Merged(std::move(merged), Parsed(quick));
    return budget == Budget::kTiny ? Merged(Merged(std::move(merged), Parsed(kTiny)), Parsed(tiny)) : merged;
  };
  const json prior = recipe(kPrior, kShortPrior, kTinyPrior), maml = recipe(kMaml, kShortMaml, kTinyMaml),
             universal = recipe(kUniversal, kShortUniversal, "{}");
  std::vector<Learner> learners;
  for (const auto& [label, specification] : {std::pair{kVaporPrior, prior}, {kVaporUniversal, universal}}) {
    learners.push_back({label, TrainingData::kFleet, Merged(specification, order)});
    learners.push_back({Unconstrained(label), TrainingData::kFleet, specification});
  }
  learners.push_back({kVaporMaml, TrainingData::kFleet, Merged(maml, order)});
  learners.push_back({kVaporTold, TrainingData::kFleet, Merged(universal, order)});
  learners.back().specification["model"]["latent_size"] = 27;
  return learners;
}

}  // namespace metaekf::experiments
