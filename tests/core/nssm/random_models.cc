#include "tests/core/nssm/random_models.h"

#include <utility>

#include "core/base/rng.h"

namespace metaekf::nssm {

std::vector<ModelCase> ModelCases() {
  using autodiff::Activation;
  const auto block = [](std::vector<int32_t> widths, Activation activation) {
    return nn::BlockSpec{.hidden_widths = std::move(widths),
                         .activation = activation,
                         .activation_parameter = autodiff::DefaultParameter(activation)};
  };
  ModelSpec one{.kind = Case::kInputOutput, .input_size = 1, .output_size = 2, .state_size = 0, .latent_size = 3, .window = 2};
  one.encoder = block({4}, Activation::kElu);
  one.transition.block = block({4}, Activation::kTanh);
  one.output_decoder = block({}, Activation::kTanh);
  one.precision = Precision::kFloat64;
  ModelSpec two{.kind = Case::kStateInputOutput, .input_size = 1, .output_size = 2, .state_size = 2, .latent_size = 3, .window = 1};
  two.encoder = block({4}, Activation::kMish);
  two.transition.block = block({3}, Activation::kSoftplus);
  two.state_decoder = block({3}, Activation::kSwish);
  two.output_decoder = block({3}, Activation::kTanh);
  two.precision = Precision::kFloat64;
  ModelSpec curl = two;
  curl.output_decoder = block({3}, Activation::kSwish);
  curl.curl_free_positions = {1, 0};

  ModelSpec beta = curl;
  beta.encoder = beta.output_decoder = block({4, 3}, Activation::kSwish);
  beta.encoder.activation_parameter = 1.7;  // fixed
  beta.output_decoder.activation_parameter = 0.6;
  beta.output_decoder.trained_beta = true;

  ModelSpec angle = curl;
  angle.angles = {.states = {1}, .mean = Eigen::Vector2d(0.3, 0.4), .scale = Eigen::Vector2d(1, 1.5)};

  const LossSpec latent{.horizon = 3, .rollout = RolloutMode::kLatent, .state_weight = 0, .reconstruction_weight = 0.5};
  const LossSpec state{.horizon = 3, .rollout = RolloutMode::kState, .stride = 2, .state_weight = 0.7, .reconstruction_weight = 1.3};
  std::vector<ModelCase> cases;
  for (const auto form : {TransitionForm::kAutonomous, TransitionForm::kAdditive, TransitionForm::kJoint}) {
    for (const auto bypass : {Bypass::kNone, Bypass::kSkip, Bypass::kLinear}) {
      const std::string suffix =
          ", form " + std::to_string(static_cast<int>(form)) + ", bypass " + std::to_string(static_cast<int>(bypass));
      ModelSpec spec = one;
      spec.transition.form = form;
      spec.transition.bypass = bypass;
      if (bypass == Bypass::kLinear) spec.transition.input_time = InputTime::kNext;
      if (bypass == Bypass::kSkip) spec.transition.increment_scale = 0.3;
      cases.push_back({"Case I" + suffix, spec, latent});
      spec = two;
      spec.transition.form = form;
      spec.transition.bypass = bypass;
      LossSpec two_latent = latent;
      two_latent.state_weight = 0.7;
      cases.push_back({"Case II, latent" + suffix, spec, two_latent});
      cases.push_back({"Case II, state" + suffix, spec, state});
    }
  }
  ModelSpec ordered = two;
  ordered.state_set = {.matrix = {1, -1}, .bounds = {0.4}};
  cases.push_back({"Case II, ordered states", ordered, state, false});
  for (ModelSpec boxed : {one, two}) {
    boxed.output_set = {.matrix = {1, 0, -1, 0, 0, 1, 0, -1}, .bounds = {2, 1, 3, 1}};
    cases.push_back({boxed.is_case_one() ? "Case I, outputs in a box" : "Case II, outputs in a box", boxed, latent});
  }
  LossSpec one_step = state;
  one_step.horizon = 1;
  cases.push_back({"Case II, one step", two, one_step});
  cases.push_back({"curl-free, one step", curl, one_step});
  cases.push_back({"curl-free, three steps", curl, state});
  cases.push_back({"curl-free, a state is an angle", angle, state});
  cases.push_back({"curl-free, swish with fixed and trained beta", beta, state});
  LossSpec whole = latent;
  whole.horizon = LossSpec::kWholeSet;
  cases.push_back({"Case I, whole set", one, whole});
  ModelSpec no_inputs = two;
  no_inputs.input_size = 0;
  cases.push_back({"Case II, no inputs", no_inputs, state});
  ModelSpec linear = one;
  linear.encoder = linear.transition.block = block({}, Activation::kTanh);
  linear.encoder.bias = false;
  cases.push_back({"Case I, linear blocks", linear, latent});
  for (const Activation kinked : {Activation::kRelu, Activation::kLeakyRelu, Activation::kSelu}) {
    ModelSpec piecewise = two;
    piecewise.encoder = piecewise.transition.block = piecewise.output_decoder = block({4, 3}, kinked);
    cases.push_back({"Case II, kinked activation " + std::to_string(static_cast<int>(kinked)), piecewise, state, false});
  }
  return cases;
}

data::Trajectory RandomTrajectory(const ModelSpec& spec, int64_t length, uint64_t seed) {
  base::Rng rng(seed);
  data::Trajectory trajectory;
  trajectory.sample_period_s = 0.1;
  for (auto [matrix, rows] : {std::pair{&trajectory.inputs, spec.input_size}, {&trajectory.outputs, spec.output_size},
                              {&trajectory.states, spec.state_size}}) {
    matrix->resize(rows, length);
    for (Eigen::Index i = 0; i < matrix->size(); ++i) matrix->data()[i] = rng.Normal();
  }
  return trajectory;
}

std::vector<double> RandomParameters(const Model& model, uint64_t seed) {
  std::vector<double> parameters = model.InitialParameters(seed);
  base::Rng rng(seed + 1000);
  for (double& value : parameters) value += 0.1 * rng.Normal();
  return parameters;
}

}  // namespace metaekf::nssm
