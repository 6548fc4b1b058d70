#include "core/experiments/vapor_compression_learners.h"

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
  "clip_norm": 2, "validation_period": 100, "warmup_horizon": 5, "warmup_lr": 0.001, "outer_lr": 0.0003, "final_outer_lr": 1e-5
})json";

constexpr char kMaml[] = R"json({
  "algorithm": "MAML", "task_batch": 4, "iterations": 27000, "warmup_iterations": 24000, "horizon_growth_iterations": 1000,
  "inner_loop": {"steps": 10, "learning_rate": 0.5, "learned_rates": true, "curvature_rates": true, "adapted_mask": "transition.3.weight"},
  "adaptation": {"steps": 10}
})json";

constexpr char kUniversal[] = R"json({
  "algorithm": "SUPERVISED", "task_batch": 8, "iterations": 30000, "warmup_iterations": 24000, "horizon_growth_iterations": 2000,
  "inner_loop": {"steps": 1}, "adaptation": {"steps": 0}
})json";

/// Of a quick study.
constexpr char kShort[] = R"json({"iterations": 6900, "warmup_iterations": 6500, "horizon_growth_iterations": 150})json";
constexpr char kShortUniversal[] = R"json({"iterations": 8000, "warmup_iterations": 6500, "horizon_growth_iterations": 500})json";
/// To see that everything runs.
constexpr char kTiny[] = R"json({
  "iterations": 8, "warmup_iterations": 4, "horizon_growth_iterations": 2, "task_batch": 2, "target_samples": 60, "context_samples": 60,
  "validation_period": 4, "validation_share": 0.2
})json";

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
  const json order = {{"model", {{"state_constraint", {{"polyhedron", {{"matrix", PressureOrder()}}}}}}}};
  const auto shortened = [budget](json recipe, const char* quick) {
    if (budget == Budget::kQuick) return Merged(std::move(recipe), Parsed(quick));
    return budget == Budget::kTiny ? Merged(std::move(recipe), Parsed(kTiny)) : recipe;
  };
  const json maml = Merged(Parsed(kCommon), shortened(Parsed(kMaml), kShort));
  const json universal = Merged(Parsed(kCommon), shortened(Parsed(kUniversal), kShortUniversal));
  std::vector<Learner> learners;
  for (const auto& [label, recipe] : {std::pair{kVaporMaml, maml}, {kVaporUniversal, universal}}) {
    learners.push_back({label, TrainingData::kFleet, Merged(recipe, order)});
    learners.push_back({Unconstrained(label), TrainingData::kFleet, recipe});
  }
  learners.push_back({kVaporTold, TrainingData::kFleet, Merged(universal, order)});
  learners.back().specification["model"]["latent_size"] = 27;
  return learners;
}

}  // namespace metaekf::experiments
