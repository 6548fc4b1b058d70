#include "core/experiments/localization_learners.h"

#include <nlohmann/json.hpp>

#include "absl/strings/str_cat.h"

namespace metaekf::experiments {
namespace {

using nlohmann::json;

/// What all have: states measured, the next state and the field as functions of the state and the input, in contexts that are the
/// first samples.
constexpr char kCommon[] = R"json({
  "model": {"case": "STATE_INPUT_OUTPUT", "output_constraint": {"curl_free": {"position_states": [0, 1]}}},
  "loss": {"horizon": 1, "rollout": "STATE"},
  "context_samples": 80, "target_samples": 320, "contexts_at_start": true, "validation_share": 0.2
})json";

/// The next state is the state and what a network adds; the potential is a network of a linear map of state and input. Four and
/// eight features before the last layers adapt. States weigh about as much as their noise is smaller than the field's: else a vehicle's
/// geometry is not worth learning beside the field.
constexpr char kSmall[] = R"json({
  "model": {
    "latent_size": 8, "angle_states": [2], "precision": "FLOAT64",
    "transition": {"form": "AUTONOMOUS", "bypass": "SKIP", "increment_scale": 0.05, "block": {"hidden_widths": [24, 24, 4]}},
    "output_decoder": {"hidden_widths": [32, 32, 8]}
  },
  "loss": {"state_weight": 30, "reconstruction_weight": 0},
  "task_batch": 4, "clip_norm": 2, "validation_period": 100, "iterations": 30000, "warmup_iterations": 1000,
  "warmup_lr": 0.01, "outer_lr": 0.003, "final_outer_lr": 2e-5,
  "inner_loop": {"steps": 10, "learning_rate": 1, "learned_rates": true, "curvature_rates": true,
                 "adapted_mask": "transition.3.weight,output_decoder.3.weight"},
  "adaptation": {"steps": 10}
})json";

/// A prior of the last layers over what MAML finds for the others.
constexpr char kPrior[] = R"json({
  "algorithm": "GAUSSIAN_PRIOR",
  "gaussian_prior": {"meta_iterations": 30000, "rounds": 3, "first_steps": 10, "round_steps": 6},
  "adaptation": {"optimiser": "LEVENBERG_MARQUARDT", "steps": 30, "adapted_mask": "transition.3,output_decoder.3"}
})json";

/// Of a quick study: what eight features of the field gain comes after more iterations.
constexpr char kShort[] = R"json({
  "model": {"output_decoder": {"hidden_widths": [32, 32, 4]}},
  "iterations": 3000, "warmup_iterations": 400, "gaussian_prior": {"meta_iterations": 3000}
})json";
/// To see that everything runs.
constexpr char kTiny[] = R"json({
  "iterations": 8, "warmup_iterations": 4, "task_batch": 2, "validation_period": 4,
  "gaussian_prior": {"meta_iterations": 8, "rounds": 1, "first_steps": 2, "round_steps": 2}, "adaptation": {"steps": 3}
})json";

/// 646,372 parameters, of which the last two encoder layers, transition and decoders adapt in ten steps. Rates are fixed, as printed,
/// but larger (β_in = 1e-3, β_out = 1e-4 there), and outer steps a thirtieth of those printed.
constexpr char kPrinted[] = R"json({
  "model": {
    "latent_size": 128, "precision": "FLOAT32",
    "encoder": {"hidden_widths": [256, 128, 128, 64, 32, 32]},
    "transition": {"form": "AUTONOMOUS", "block": {"hidden_widths": [256, 256, 256, 256, 256, 256]}},
    "state_decoder": {"hidden_widths": [32, 64, 128, 256]},
    "output_decoder": {"hidden_widths": [64, 64, 128, 128, 256, 256]}
  },
  "task_batch": 2, "clip_norm": 1, "validation_period": 50, "iterations": 1000, "warmup_iterations": 400,
  "warmup_lr": 0.001, "outer_lr": 0.0003, "final_outer_lr": 2e-5,
  "inner_loop": {"steps": 10, "learning_rate": 0.01, "adapted_mask": "encoder.5-6,transition,*_decoder"},
  "adaptation": {"steps": 10}
})json";

json Activations(const char* activation) {
  json blocks;
  blocks["transition"]["block"]["activation"] = activation;
  for (const char* block : {"encoder", "state_decoder", "output_decoder"}) blocks[block]["activation"] = activation;
  return {{"model", blocks}};
}

json Merged(json a, const json& b) {
  a.merge_patch(b);
  return a;
}

json Parsed(const char* text) { return json::parse(text); }

}  // namespace

std::string Printed(const std::string& label) { return absl::StrCat(label, ", printed"); }

std::vector<Learner> LocalizationLearners(Budget budget) {
  std::vector<Learner> learners;
  const auto add = [&learners](const std::string& label, const json& network, const json& changes) {
    learners.push_back({label, TrainingData::kFleet, Merged(Merged(Parsed(kCommon), network), changes)});
  };
  const json swish = Activations("SWISH"), tanh = Activations("TANH");
  const json maml = {{"algorithm", "MAML"}}, first_order = {{"algorithm", "FIRST_ORDER_MAML"}};
  const auto add_free = [&](const std::string& label, const json& network, const json& changes) {
    add(label, network, changes);
    learners.back().specification["model"].erase("output_constraint");
  };
  // Reptile has no gradient for rates, and trains what its inner loop adapts: everything.
  const json reptile = Parsed(R"json({"algorithm": "REPTILE", "inner_loop": {"optimiser": "ADAM", "learning_rate": 0.00002,
                                      "learned_rates": false, "curvature_rates": false, "adapted_mask": "*"}})json");
  const auto add_family = [&](const json& network, const auto& label) {
    for (const auto& [name, algorithm] : {std::pair{"MAML", maml}, {"FO-MAML", first_order}, {"Reptile", reptile}}) {
      add(label(absl::StrCat(name, ", swish")), network, Merged(algorithm, swish));
      add(label(absl::StrCat(name, ", tanh")), network, Merged(algorithm, tanh));
    }
    add_free(label(kMamlFree), network, Merged(maml, swish));
  };
  // What the budget says stands behind the recipe.
  const json shorter = budget == Budget::kQuick ? Parsed(kShort) : budget == Budget::kTiny ? Parsed(kTiny) : json::object();
  const json small = Merged(Parsed(kSmall), shorter), prior = Merged(Merged(Parsed(kSmall), Parsed(kPrior)), shorter);
  add_family(small, [](const std::string& label) { return label; });
  add(kPriorSwish, prior, swish);
  add_free(kPriorFree, prior, swish);
  // Minutes do not train the printed networks, and in seconds the small ones stand in for them.
  if (budget != Budget::kQuick) add_family(budget == Budget::kTiny ? small : Parsed(kPrinted), Printed);
  return learners;
}

}  // namespace metaekf::experiments
