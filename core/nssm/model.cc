#include "core/nssm/model.h"

#include <cmath>
#include <numbers>

#include "core/autodiff/scan.h"
#include "core/base/status.h"
#include "core/linalg/decompositions.h"
#include "core/physics/curl_free.h"

namespace metaekf::nssm {

using autodiff::Graph;
using autodiff::kNoValue;
using autodiff::Recurrence;
using autodiff::ScanResult;
using autodiff::Value;

absl::StatusOr<Model> Model::Create(const ModelSpec& spec) {
  if (spec.input_size < 0 || spec.output_size < 0 || spec.state_size < 0) {
    return absl::InvalidArgumentError("the model's input, output and state sizes are not known yet");
  }
  std::optional<physics::Polyhedron> state_set, output_set;
  if (!spec.state_set.empty()) {
    METAEKF_ASSIGN_OR_RETURN(state_set, PolyhedronOf(spec.state_set, spec.state_size));
  }
  if (!spec.output_set.empty()) {
    METAEKF_ASSIGN_OR_RETURN(output_set, PolyhedronOf(spec.output_set, spec.output_size));
  }
  return Model(spec, std::move(state_set), std::move(output_set));
}

Model::Model(const ModelSpec& spec, std::optional<physics::Polyhedron> state_set, std::optional<physics::Polyhedron> output_set)
    : spec_(spec), state_set_(std::move(state_set)), output_set_(std::move(output_set)) {
  const int32_t latent = spec.latent_size, inputs = spec.input_size;
  const TransitionSpec& transition = spec.transition;
  const bool joint = transition.form == TransitionForm::kJoint && inputs > 0;
  if (!spec.fits_start()) {
    encoder_ = nn::Block("encoder", spec.encoder, EncodedStartSize() + (spec.is_case_one() ? 0 : inputs), latent, &layout_);
  }
  transition_ = nn::Block("transition", transition.block, latent + (joint ? inputs : 0), latent, &layout_);
  if (transition.form == TransitionForm::kAdditive && inputs > 0) {
    transition_input_ = nn::Block("transition_input", transition.input_block, inputs, latent, &layout_);
  }
  if (transition.bypass == Bypass::kLinear) {
    state_bypass_ = layout_.Add("transition.state_bypass.weight", latent, latent);
    if (transition.form != TransitionForm::kAutonomous && inputs > 0) {
      input_bypass_ = layout_.Add("transition.input_bypass.weight", latent, inputs);
    }
  }
  if (!spec.is_case_one()) {
    state_decoder_ = nn::Block("state_decoder", spec.state_decoder, latent, spec.state_size, &layout_);
  }
  const int32_t decoded = spec.is_curl_free() ? 1 : spec.output_size;
  output_decoder_ = nn::Block("output_decoder", spec.output_decoder, latent, decoded, &layout_);
  const auto constrain = [this](const std::string& name, const physics::Polyhedron& set, const PolyhedronSpec& in) {
    const bool has_units = in.mean.size() > 0;
    const Eigen::Index n = set.dimension();
    return physics::PolyhedralLayer(name, set, has_units ? in.mean : Eigen::VectorXd(Eigen::VectorXd::Zero(n)),
                                    has_units ? in.scale : Eigen::VectorXd(Eigen::VectorXd::Ones(n)), &layout_);
  };
  if (state_set_) state_constraint_ = constrain("state_constraint", *state_set_, spec.state_set);
  if (output_set_) output_constraint_ = constrain("output_constraint", *output_set_, spec.output_set);
}

int32_t Model::start_size() const {
  return spec_.is_case_one() ? spec_.window * (spec_.input_size + spec_.output_size) : spec_.state_size;
}

int32_t Model::EncodedStartSize() const { return start_size() + 2 * static_cast<int32_t>(spec_.angles.states.size()); }

void Model::StartWithExactReconstruction(std::span<double> parameters) const {
  // Where there are latents enough, sines, cosines and inputs leave what is decoded alone.
  const Eigen::MatrixXd encoder = nn::TensorIn(layout_, "encoder.0.weight", parameters);
  const Eigen::MatrixXd seen = encoder.cols() <= encoder.rows() ? encoder : Eigen::MatrixXd(encoder.leftCols(spec_.state_size));
  const Eigen::MatrixXd inverse = linalg::SolveLeastSquares(seen, Eigen::MatrixXd::Identity(seen.rows(), seen.rows()));
  nn::TensorIn(layout_, "state_decoder.0.weight", parameters) = inverse.topRows(spec_.state_size);
}

std::vector<double> Model::InitialParameters(uint64_t seed) const {
  std::vector<double> parameters(static_cast<size_t>(layout_.size()), 0.0);
  base::Rng rng(seed);
  for (const nn::Block* block : {&encoder_, &transition_, &transition_input_, &state_decoder_, &output_decoder_}) {
    block->Initialise(layout_, &rng, parameters);
  }
  if (state_set_) state_constraint_.Initialise(layout_, parameters);
  if (output_set_) output_constraint_.Initialise(layout_, parameters);
  if (!spec_.is_case_one() && spec_.encoder.hidden_widths.empty() && spec_.state_decoder.hidden_widths.empty()) {
    StartWithExactReconstruction(parameters);
  }
  if (spec_.transition.bypass == Bypass::kLinear) {
    const nn::Tensor& state_bypass = layout_.tensors()[state_bypass_];
    // Slow, slightly damped modes: a long rollout neither dies out nor explodes at the start of training.
    for (int32_t i = 0; i < spec_.latent_size; ++i) {
      parameters[static_cast<size_t>(state_bypass.offset + int64_t{i} * (spec_.latent_size + 1))] = 0.98;
    }
    if (input_bypass_ != 0) {
      const nn::Tensor& input_bypass = layout_.tensors()[input_bypass_];
      for (int64_t i = 0; i < input_bypass.size(); ++i) {
        parameters[static_cast<size_t>(input_bypass.offset + i)] = 0.1 * rng.Normal() / std::sqrt(input_bypass.in);
      }
    }
  }
  return parameters;
}

Value ModelGraph::WithAngles(Value state) const {
  const AngleSpec& angles = model_.spec_.angles;
  if (angles.states.empty()) return state;
  std::vector<Value> rows = {state};
  for (const int32_t i : angles.states) {
    const bool has_units = angles.scale.size() > 0;
    const int32_t cols = graph_->node(state).cols;
    const Value from_mean = graph_->Scale(graph_->SliceRows(state, i, 1), has_units ? angles.scale[i] : 1);
    const Value angle = graph_->Add(from_mean, graph_->Constant(has_units ? angles.mean[i] : 0, 1, cols));
    rows.push_back(graph_->Apply(autodiff::Activation::kSine, 0, 0, angle));
    // cos z = sin(z + π/2), which leaves all its derivatives to be taken.
    rows.push_back(graph_->Apply(autodiff::Activation::kSine, 0, 0, graph_->Add(angle, graph_->Constant(std::numbers::pi / 2, 1, cols))));
  }
  return graph_->ConcatRows(rows);
}

Value ModelGraph::Encode(Value start, Value input) const {
  if (!model_.spec_.is_case_one()) start = WithAngles(start);
  const bool with_input = !model_.spec_.is_case_one() && model_.spec_.input_size > 0;
  return with_input ? model_.encoder_.ApplyStacked(graph_, parameters_, start, input)
                    : model_.encoder_.Apply(graph_, parameters_, start);
}

Value ModelGraph::Advance(Value latent, Value input) const {
  const TransitionSpec& spec = model_.spec_.transition;
  const bool takes_input = spec.form != TransitionForm::kAutonomous && model_.spec_.input_size > 0;
  const bool joint = spec.form == TransitionForm::kJoint && takes_input;
  const Value from_input =
      spec.form == TransitionForm::kAdditive && takes_input ? model_.transition_input_.Apply(graph_, parameters_, input) : kNoValue;
  Value bypass = kNoValue;
  if (spec.bypass == Bypass::kSkip) bypass = latent;
  if (spec.bypass == Bypass::kLinear) {
    if (takes_input) bypass = graph_->MatMul(parameters_[model_.input_bypass_], input, true);
    bypass = graph_->AddOrEither(bypass, graph_->MatMul(parameters_[model_.state_bypass_], latent, true));
  }
  const bool scaled = spec.increment_scale != 1;
  const Value shift = scaled ? from_input : graph_->AddOrEither(from_input, bypass);
  const Value increment = joint ? model_.transition_.ApplyStacked(graph_, parameters_, latent, input, shift)
                                : model_.transition_.Apply(graph_, parameters_, latent, shift);
  return scaled ? graph_->AddOrEither(graph_->Scale(increment, spec.increment_scale), bypass) : increment;
}

Value ModelGraph::State(Value latent) const {
  const Value decoded = model_.state_decoder_.Apply(graph_, parameters_, latent);
  return model_.state_set_ ? model_.state_constraint_.Apply(graph_, parameters_, decoded) : decoded;
}

Value ModelGraph::Output(Value latent, Value state) const {
  const Value decoded = model_.output_decoder_.Apply(graph_, parameters_, latent);
  if (model_.output_set_) return model_.output_constraint_.Apply(graph_, parameters_, decoded);
  if (!model_.spec_.is_curl_free()) return decoded;
  return physics::CurlFree(graph_, decoded, state, model_.spec_.curl_free_positions);
}

Step BuildStep(const Model& model, RolloutMode mode, const ModelGraph& parts, Value carry, Value input) {
  if (mode == RolloutMode::kState) {
    const Value latent = parts.Encode(carry, input);
    const Value state = parts.State(parts.Advance(latent, input));
    return {state, state, parts.Output(latent, carry)};
  }
  const Value latent = parts.Advance(carry, input);
  if (model.spec().is_case_one()) return {latent, kNoValue, parts.Output(latent, kNoValue)};
  return {latent, parts.State(latent), parts.Output(carry, kNoValue)};
}

Value StartOfRollout(const ModelGraph& parts, RolloutMode mode, Value start, Value first_input) {
  return mode == RolloutMode::kState ? start : parts.Encode(start, first_input);
}

Rollout BuildRollout(const Model& model, RolloutMode mode, const nn::ParameterValues& parameters, Value carry,
                     Value inputs, int32_t length, Graph* graph) {
  if (length == 1) {
    const Step step = BuildStep(model, mode, ModelGraph(&model, graph, parameters), carry, inputs);
    return {step.state, step.output, step.next, carry};
  }
  Recurrence rec;
  rec.length = length;
  int32_t slot = 0;
  const auto body_input = [&](int32_t rows, int32_t cols) { return rec.body.Input(slot++, 0, rows, cols); };
  nn::ParameterValues body_parameters;
  for (const Value parameter : parameters) {
    body_parameters.push_back(body_input(graph->node(parameter).rows, graph->node(parameter).cols));
    rec.constants.push_back({body_parameters.back(), parameter});
  }
  const int32_t width = graph->node(carry).cols;
  const Value body_carry = body_input(graph->node(carry).rows, width);
  rec.carries.push_back({body_carry, carry});
  Value input = kNoValue;
  if (inputs != kNoValue) {
    input = body_input(model.spec().input_size, width);
    rec.sequences.push_back({input, inputs});
  }
  const Step step = BuildStep(model, mode, ModelGraph(&model, &rec.body, body_parameters), body_carry, input);
  rec.carry_out.push_back(step.next);
  ScanResult result(graph, std::move(rec));
  return {step.state == kNoValue ? kNoValue : result.AtEveryStep(step.state), result.AtEveryStep(step.output),
          result.Final(0), result.AtEveryStep(body_carry)};
}

}  // namespace metaekf::nssm
