#include "tests/server/support/tiny_models.h"

#include <cmath>
#include <nlohmann/json.hpp>

#include "core/meta/training_spec.h"
#include "server/convert/spec.h"
#include "tests/support/bundles.h"

namespace metaekf::server {
namespace {

v1::Samples Simulate(const std::string& name, double a, uint32_t samples) {
  v1::Samples message;
  message.set_trajectory(name);
  message.set_sample_count(samples);
  message.set_sample_period_s(0.1);
  double y = 0;
  for (uint32_t t = 0; t < samples; ++t) {
    const double u = std::sin(0.7 * t) + std::sin(0.23 * t + a);
    message.add_inputs(u);
    message.add_outputs(y);
    y = a * y + 0.3 * u;
  }
  return message;
}

nssm::Bundle MakeBundle(const v1::TrainingSpec& message, uint64_t seed) {
  meta::TrainingSpec spec = ToCore("spec", message).value();
  nssm::Bundle bundle = support::UnitBundle(nssm::Model::Create(spec.model).value());
  bundle.parameters = bundle.model.InitialParameters(seed);
  nssm::RoundToPrecision(spec.model.precision, &bundle.parameters);
  bundle.training = meta::ToJson(spec);
  return bundle;
}

v1::TrainingSpec StateSpec(int32_t states) {
  v1::TrainingSpec spec;
  v1::ModelSpec& model = *spec.mutable_model();
  model.set_case_(v1::ModelSpec::STATE_INPUT_OUTPUT);
  model.set_input_size(1);
  model.set_output_size(1);
  model.set_state_size(states);
  model.set_latent_size(3);
  return spec;
}

}  // namespace

nssm::Bundle TinyBundle(uint64_t seed) {
  v1::TrainingSpec spec = TinySpec(1);
  spec.mutable_model()->set_input_size(1);
  spec.mutable_model()->set_output_size(1);
  return MakeBundle(spec, seed);
}

nssm::Bundle TinyStateBundle(int32_t states) { return MakeBundle(StateSpec(states), 1); }

nssm::Bundle LargeStateBundle() {
  v1::TrainingSpec spec = StateSpec(2);
  v1::ModelSpec& model = *spec.mutable_model();
  for (v1::BlockSpec* block : {model.mutable_encoder(), model.mutable_transition()->mutable_block(), model.mutable_output_decoder()}) {
    for (int layer = 0; layer < 2; ++layer) block->add_hidden_widths(128);
  }
  return MakeBundle(spec, 1);
}

v1::TrainingSpec TinySpec(uint32_t iterations) {
  v1::TrainingSpec spec;
  v1::ModelSpec& model = *spec.mutable_model();
  model.set_case_(v1::ModelSpec::INPUT_OUTPUT);
  model.set_latent_size(2);
  model.set_window(3);
  model.mutable_transition()->mutable_block()->add_hidden_widths(4);
  spec.mutable_loss()->set_horizon(4);
  spec.mutable_inner_loop()->set_steps(2);
  spec.mutable_inner_loop()->set_learning_rate(0.01);
  spec.mutable_adaptation()->set_steps(5);
  spec.set_context_samples(20);
  spec.set_target_samples(20);
  spec.set_task_batch(2);
  spec.set_iterations(iterations);
  spec.set_validation_period(20);
  spec.set_seed(7);
  return spec;
}

std::vector<v1::Samples> TinyFleet() {
  std::vector<v1::Samples> fleet;
  for (int i = 0; i < 5; ++i) {
    fleet.push_back(Simulate("system " + std::to_string(i), 0.5 + 0.08 * i, 60));
  }
  return fleet;
}

v1::Samples TinyContext(uint32_t samples) { return Simulate("new", 0.72, samples); }

std::vector<v1::CreateTrainingJobRequest> TinyJob(const std::string& model, uint32_t iterations) {
  std::vector<v1::CreateTrainingJobRequest> requests(1);
  auto& header = *requests[0].mutable_header();
  header.set_model("models/" + model);
  *header.mutable_spec() = TinySpec(iterations);
  header.mutable_channels()->add_inputs()->set_name("u1");
  header.mutable_channels()->add_outputs()->set_name("y1");
  for (const v1::Samples& samples : TinyFleet()) {
    *requests.emplace_back().mutable_samples() = samples;
  }
  return requests;
}

}  // namespace metaekf::server
