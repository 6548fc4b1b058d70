#pragma once

#include <utility>
#include <vector>

#include "core/nssm/loss.h"
#include "tests/core/nssm/random_models.h"

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

/// The small network's free run over so many steps, and its gradient.
class SmallRollout {
 public:
  explicit SmallRollout(int64_t steps)
      : model_(*nssm::Model::Create(SmallSpec())),
        shape_(*nssm::ShapeOfLoss(model_.spec(), kLoss, steps + 1)),
        data_(nssm::CutLossData<float>(model_.spec(), kLoss, nssm::RandomTrajectory(model_.spec(), steps + 1, 1), 0, shape_)),
        mask_(*nn::ParseMask("transition,output_decoder", model_.layout())),
        function_(model_, kLoss, shape_, mask_, mask_),
        scratch_(function_.MakeScratch()),
        gradient_(static_cast<size_t>(model_.layout().size())) {
    const std::vector<double> initial = model_.InitialParameters(1);
    parameters_.assign(initial.begin(), initial.end());
  }

  void ComputeGradient() { function_.Gradient(parameters_.data(), data_, gradient_.data(), &scratch_); }

 private:
  inline static const nssm::LossSpec kLoss{.horizon = nssm::LossSpec::kWholeSet, .state_weight = 0, .reconstruction_weight = 0};
  nssm::Model model_;
  nssm::LossShape shape_;
  nssm::LossData<float> data_;
  nn::Mask mask_;
  nssm::LossFunction<float> function_;
  nssm::LossFunction<float>::Scratch scratch_;
  std::vector<float> parameters_, gradient_;
};

}  // namespace metaekf::benchmark
