#pragma once

#include <utility>
#include <vector>

#include "core/nssm/model.h"

namespace metaekf::benchmark {

/// The paper's localisation network: states (p_X, p_Y, heading), three inputs, the magnetic field as a gradient.
inline nssm::ModelSpec LocalisationSpec() {
  const auto block = [](std::vector<int32_t> widths) {
    return nn::BlockSpec{.hidden_widths = std::move(widths), .activation = autodiff::Activation::kSwish};
  };
  nssm::ModelSpec spec{.kind = nssm::Case::kStateInputOutput, .input_size = 3, .output_size = 2, .state_size = 3, .latent_size = 128, .window = 1};
  spec.encoder = block({256, 128, 128, 64, 32, 32});
  spec.transition.block = block({256, 256, 256, 256, 256, 256});
  spec.transition.form = nssm::TransitionForm::kAutonomous;
  spec.state_decoder = block({32, 64, 128, 256});
  spec.output_decoder = block({64, 64, 128, 128, 256, 256});
  spec.curl_free_positions = {0, 1};
  return spec;
}

/// Latent 3, transition 4-16-3 with a skip, linear output: 134 parameters with the linear start that the peer leaves out.
inline nssm::ModelSpec SmallSpec() {
  nssm::ModelSpec spec{.kind = nssm::Case::kInputOutput, .input_size = 1, .output_size = 1, .state_size = 0, .latent_size = 3, .window = 1};
  spec.transition.block = {.hidden_widths = {16}, .output_scale = 0.01};
  spec.transition.bypass = nssm::Bypass::kSkip;
  spec.output_decoder.bias = false;
  return spec;
}

}  // namespace metaekf::benchmark
