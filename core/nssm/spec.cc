#include "core/nssm/spec.h"

#include <algorithm>
#include <nlohmann/json.hpp>
#include <set>

#include "core/base/status.h"

namespace metaekf::nssm {
namespace {

using autodiff::Activation;
using base::JsonFields;
using nlohmann::json;

template <typename Enum>
using Names = std::vector<std::pair<std::string, Enum>>;

const Names<Activation> kActivations = {
    {"TANH", Activation::kTanh},   {"IDENTITY", Activation::kIdentity}, {"RELU", Activation::kRelu},
    {"LEAKY_RELU", Activation::kLeakyRelu}, {"ELU", Activation::kElu},  {"SELU", Activation::kSelu},
    {"SWISH", Activation::kSwish}, {"MISH", Activation::kMish},         {"SOFTPLUS", Activation::kSoftplus},
    {"SINE", Activation::kSine}};
const Names<Case> kCases = {{"INPUT_OUTPUT", Case::kInputOutput}, {"STATE_INPUT_OUTPUT", Case::kStateInputOutput}};
const std::vector<std::pair<std::string, StartMode>> kStarts = {{"ENCODED", StartMode::kEncoded},
                                                                   {"FITTED", StartMode::kFitted}};
const Names<Precision> kPrecisions = {{"FLOAT32", Precision::kFloat32}, {"FLOAT64", Precision::kFloat64}};
const Names<TransitionForm> kForms = {{"JOINT", TransitionForm::kJoint},
                                      {"AUTONOMOUS", TransitionForm::kAutonomous},
                                      {"ADDITIVE", TransitionForm::kAdditive}};
const Names<Bypass> kBypasses = {{"NONE", Bypass::kNone}, {"SKIP", Bypass::kSkip}, {"LINEAR", Bypass::kLinear}};
const Names<InputTime> kInputTimes = {{"CURRENT", InputTime::kCurrent}, {"NEXT", InputTime::kNext}};
const Names<RolloutMode> kRollouts = {{"LATENT", RolloutMode::kLatent}, {"STATE", RolloutMode::kState}};

template <typename Enum>
std::string NameOf(const Names<Enum>& names, Enum value) {
  for (const auto& [name, candidate] : names) {
    if (candidate == value) return name;
  }
  return "";
}

constexpr int32_t kLargestWidth = 1 << 16;
constexpr double kLargeNumber = 1e12;

nn::BlockSpec ReadBlock(JsonFields* parent, const std::string& name) {
  JsonFields fields = parent->Object(name);
  nn::BlockSpec spec;
  spec.hidden_widths = fields.Integers("hidden_widths", 1, kLargestWidth);
  spec.activation = fields.Choice("activation", Activation::kTanh, kActivations);
  spec.activation_parameter = fields.Number("activation_parameter", autodiff::DefaultParameter(spec.activation), 0, 1e3);
  spec.trained_beta = fields.Bool("trained_beta", false);
  if (spec.trained_beta && spec.activation != Activation::kSwish) fields.Fail("trained_beta", "only SWISH has a beta");
  spec.bias = !fields.Bool("no_bias", false);
  spec.output_scale = fields.Number("output_scale", 1, 0, 1e3);
  parent->Include(fields.Finish());
  return spec;
}

json BlockJson(const nn::BlockSpec& spec) {
  return {{"hidden_widths", spec.hidden_widths},
          {"activation", NameOf(kActivations, spec.activation)},
          {"activation_parameter", spec.activation_parameter},
          {"trained_beta", spec.trained_beta},
          {"no_bias", !spec.bias},
          {"output_scale", spec.output_scale}};
}

TransitionSpec ReadTransition(JsonFields* parent) {
  JsonFields fields = parent->Object("transition");
  TransitionSpec spec;
  spec.block = ReadBlock(&fields, "block");
  spec.form = fields.Choice("form", TransitionForm::kJoint, kForms);
  if (spec.form != TransitionForm::kAdditive && fields.Has("input_block")) {
    fields.Fail("input_block", "only the ADDITIVE form has one");
  }
  spec.input_block = ReadBlock(&fields, "input_block");
  spec.bypass = fields.Choice("bypass", Bypass::kNone, kBypasses);
  spec.input_time = fields.Choice("input_time", InputTime::kCurrent, kInputTimes);
  spec.increment_scale = fields.Number("increment_scale", 1, 1e-9, 1e9);
  parent->Include(fields.Finish());
  return spec;
}

PolyhedronSpec ReadPolyhedron(JsonFields* parent, int32_t size) {
  PolyhedronSpec spec;
  if (!parent->Has("polyhedron")) return spec;
  JsonFields fields = parent->Object("polyhedron");
  spec.matrix = fields.Numbers("matrix");
  spec.bounds = fields.Numbers("bounds");
  spec.rays = fields.Numbers("rays");
  if (spec.empty()) fields.Fail("matrix", "give the rows of G, or rays");
  if (!spec.rays.empty() && spec.matrix.size() + spec.bounds.size() > 0) fields.Fail("rays", "stand instead of matrix and bounds");
  parent->Include(fields.Finish());
  if (!spec.empty() && size != ModelSpec::kFromData) {
    const absl::Status status = PolyhedronOf(spec, size).status();
    if (!status.ok()) parent->Fail("polyhedron", std::string(status.message()));
  }
  return spec;
}

json PolyhedronJson(const PolyhedronSpec& spec) {
  if (!spec.rays.empty()) return {{"polyhedron", {{"rays", spec.rays}}}};
  return {{"polyhedron", {{"matrix", spec.matrix}, {"bounds", spec.bounds}}}};
}

void ReadStateConstraint(JsonFields* parent, ModelSpec* spec) {
  if (!parent->Has("state_constraint")) return;
  if (spec->is_case_one()) return parent->Fail("state_constraint", "Case I (INPUT_OUTPUT) has no states");
  JsonFields fields = parent->Object("state_constraint");
  spec->state_set = ReadPolyhedron(&fields, spec->state_size);
  parent->Include(fields.Finish());
}

void ReadAngles(JsonFields* fields, ModelSpec* spec) {
  spec->angles.states = fields->Integers("angle_states", 0, kLargestWidth);
  if (!spec->angles.states.empty() && spec->is_case_one()) fields->Fail("angle_states", "Case I (INPUT_OUTPUT) has no states");
  std::set<int32_t> seen;
  for (const int32_t state : spec->angles.states) {
    if (spec->state_size != ModelSpec::kFromData && !spec->is_case_one() && state >= spec->state_size) {
      fields->Fail("angle_states", absl::StrCat("state ", state, " does not exist: states count from 0 to ", spec->state_size - 1));
    }
    if (!seen.insert(state).second) fields->Fail("angle_states", absl::StrCat("state ", state, " stands there twice"));
  }
}

void ReadConstraint(JsonFields* parent, ModelSpec* spec) {
  JsonFields fields = parent->Object("output_constraint");
  spec->output_set = ReadPolyhedron(&fields, spec->output_size);
  if (fields.Has("curl_free") && fields.Has("polyhedron")) fields.Fail("polyhedron", "stands instead of curl_free, not beside it");
  if (fields.Has("curl_free")) {
    JsonFields curl_free = fields.Object("curl_free");
    spec->curl_free_positions = curl_free.Integers("position_states", 0, kLargestWidth);
    const size_t count = spec->curl_free_positions.size();
    if (count != 2 && count != 3) curl_free.Fail("position_states", "name the 2 or 3 states that are the position");
    fields.Include(curl_free.Finish());
  }
  parent->Include(fields.Finish());
}

void CheckCurlFree(JsonFields* fields, const ModelSpec& spec) {
  if (spec.is_case_one()) fields->Fail("output_constraint.curl_free", "needs Case II: the position is part of the state");
  const int32_t positions = static_cast<int32_t>(spec.curl_free_positions.size());
  if (spec.output_size != ModelSpec::kFromData && spec.output_size != positions) {
    fields->Fail("output_constraint.curl_free.position_states",
                 absl::StrCat("a gradient has as many components as positions: ", positions, " positions, ",
                              spec.output_size, " outputs"));
  }
  for (const int32_t position : spec.curl_free_positions) {
    if (spec.state_size != ModelSpec::kFromData && position >= spec.state_size) {
      fields->Fail("output_constraint.curl_free.position_states",
                   absl::StrCat("state ", position, " does not exist: states count from 0 to ", spec.state_size - 1));
    }
  }
  const auto require_smooth = [fields](const std::string& block, const nn::BlockSpec& b) {
    if (b.hidden_widths.empty() || autodiff::IsSmooth(b.activation)) return;
    fields->Fail(absl::StrCat(block, ".activation"),
                 absl::StrCat(NameOf(kActivations, b.activation),
                              " has no continuous second derivative, which a curl-free output needs: use SWISH, TANH, MISH "
                              "or SOFTPLUS"));
  };
  require_smooth("encoder", spec.encoder);
  require_smooth("output_decoder", spec.output_decoder);
}

}  // namespace

absl::StatusOr<physics::Polyhedron> PolyhedronOf(const PolyhedronSpec& spec, int32_t size) {
  using Eigen::Index;
  using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  const std::vector<double>& numbers = spec.rays.empty() ? spec.matrix : spec.rays;
  const Index rows = static_cast<Index>(numbers.size()) / size;
  if (rows * size != static_cast<Index>(numbers.size())) {
    return absl::InvalidArgumentError(absl::StrCat(spec.rays.empty() ? "matrix: " : "rays: ", numbers.size(), " numbers are no whole rows of ",
                                                   size, ", one for each channel"));
  }
  const Eigen::Map<const RowMajor> matrix(numbers.data(), rows, size);
  if (!spec.rays.empty()) return physics::ConeOfRays(matrix.transpose());
  if (!spec.bounds.empty() && static_cast<Index>(spec.bounds.size()) != rows) {
    return absl::InvalidArgumentError(absl::StrCat("bounds: ", spec.bounds.size(), " for ", rows, " rows"));
  }
  Eigen::VectorXd bounds = Eigen::VectorXd::Zero(rows);
  if (!spec.bounds.empty()) bounds = Eigen::Map<const Eigen::VectorXd>(spec.bounds.data(), rows);
  return physics::MakePolyhedron(matrix, bounds);
}

void TakeUnits(const data::Normaliser& normaliser, ModelSpec* spec) {
  spec->state_set.mean = normaliser.states.mean;
  spec->state_set.scale = normaliser.states.scale;
  spec->angles.mean = normaliser.states.mean;
  spec->angles.scale = normaliser.states.scale;
  spec->output_set.mean = normaliser.outputs.mean;
  spec->output_set.scale = normaliser.outputs.scale;
}

absl::StatusOr<ModelSpec> ReadModelSpec(JsonFields fields) {
  ModelSpec spec;
  if (!fields.Has("case")) fields.Fail("case", "say INPUT_OUTPUT (Case I) or STATE_INPUT_OUTPUT (Case II)");
  spec.kind = fields.Choice("case", Case::kInputOutput, kCases);
  const auto size = [&](const std::string& name, int32_t low) {
    return static_cast<int32_t>(fields.Integer(name, ModelSpec::kFromData, low, kLargestWidth));
  };
  spec.input_size = size("input_size", 0);
  spec.output_size = size("output_size", 1);
  spec.state_size = size("state_size", spec.is_case_one() ? 0 : 1);
  if (spec.is_case_one()) {
    if (spec.state_size > 0) fields.Fail("state_size", "Case I (INPUT_OUTPUT) has no states");
    spec.state_size = 0;
  }
  spec.latent_size = static_cast<int32_t>(fields.Integer("latent_size", 0, 1, kLargestWidth));
  if (spec.latent_size == 0) fields.Fail("latent_size", "say how many latents the model has");
  spec.window = static_cast<int32_t>(fields.Integer("window", 10, 1, 100000));
  if (!spec.is_case_one()) spec.window = 1;
  spec.encoder = ReadBlock(&fields, "encoder");
  spec.transition = ReadTransition(&fields);
  if (spec.is_case_one() && fields.Has("state_decoder")) fields.Fail("state_decoder", "Case I (INPUT_OUTPUT) has no states");
  spec.state_decoder = ReadBlock(&fields, "state_decoder");
  spec.output_decoder = ReadBlock(&fields, "output_decoder");
  ReadConstraint(&fields, &spec);
  ReadStateConstraint(&fields, &spec);
  ReadAngles(&fields, &spec);
  spec.precision = fields.Choice("precision", Precision::kFloat32, kPrecisions);
  if (!spec.is_case_one() && spec.transition.input_time == InputTime::kNext) {
    fields.Fail("transition.input_time", "NEXT is for Case I; in Case II the transition takes u_t, as the encoder does");
  }
  spec.start = fields.Choice("start", StartMode::kEncoded, kStarts);
  if (spec.fits_start() && !spec.is_case_one()) fields.Fail("start", "FITTED is for Case I; in Case II the start is measured");
  if (spec.fits_start() && fields.Has("encoder")) fields.Fail("encoder", "a model whose start is FITTED has none");
  if (spec.is_curl_free()) CheckCurlFree(&fields, spec);
  METAEKF_RETURN_IF_ERROR(fields.Finish());
  return spec;
}

absl::StatusOr<LossSpec> ReadLossSpec(JsonFields fields, const ModelSpec& model) {
  LossSpec spec;
  spec.horizon = static_cast<int32_t>(fields.Integer("horizon", 1, 1, 10'000'000));
  if (fields.Bool("whole_set_horizon", false)) spec.horizon = LossSpec::kWholeSet;
  spec.rollout = fields.Choice("rollout", model.is_case_one() ? RolloutMode::kLatent : RolloutMode::kState, kRollouts);
  spec.stride = static_cast<int32_t>(fields.Integer("stride", 1, 1, 10'000'000));
  spec.output_weight = fields.Number("output_weight", 1, 0, kLargeNumber);
  spec.state_weight = fields.Number("state_weight", model.is_case_one() ? 0 : 1, 0, kLargeNumber);
  spec.reconstruction_weight = fields.Number("reconstruction_weight", model.is_case_one() ? 0 : 1, 0, kLargeNumber);
  if (model.is_case_one() && spec.rollout == RolloutMode::kState) {
    fields.Fail("rollout", "STATE needs Case II: Case I has no state to encode again");
  }
  if (model.is_case_one() && spec.state_weight > 0) fields.Fail("state_weight", "Case I has no states");
  if (model.is_curl_free() && spec.rollout == RolloutMode::kLatent) {
    fields.Fail("rollout", "a curl-free output needs STATE: the potential is a function of the position");
  }
  if (spec.output_weight + spec.state_weight + spec.reconstruction_weight <= 0) {
    fields.Fail("output_weight", "every term of the loss has weight 0");
  }
  METAEKF_RETURN_IF_ERROR(fields.Finish());
  return spec;
}

json ToJson(const ModelSpec& spec) {
  json result = {{"case", NameOf(kCases, spec.kind)},
                 {"latent_size", spec.latent_size},
                 {"window", spec.window},
                 {"output_decoder", BlockJson(spec.output_decoder)},
                 {"precision", NameOf(kPrecisions, spec.precision)},
                 {"start", NameOf(kStarts, spec.start)}};
  if (!spec.fits_start()) result["encoder"] = BlockJson(spec.encoder);
  json transition = {{"block", BlockJson(spec.transition.block)},
                     {"form", NameOf(kForms, spec.transition.form)},
                     {"bypass", NameOf(kBypasses, spec.transition.bypass)},
                     {"input_time", NameOf(kInputTimes, spec.transition.input_time)},
                     {"increment_scale", spec.transition.increment_scale}};
  if (spec.transition.form == TransitionForm::kAdditive) {
    transition["input_block"] = BlockJson(spec.transition.input_block);
  }
  result["transition"] = transition;
  if (spec.input_size != ModelSpec::kFromData) result["input_size"] = spec.input_size;
  if (spec.output_size != ModelSpec::kFromData) result["output_size"] = spec.output_size;
  if (spec.state_size != ModelSpec::kFromData) result["state_size"] = spec.state_size;
  if (!spec.is_case_one()) result["state_decoder"] = BlockJson(spec.state_decoder);
  if (spec.is_curl_free()) {
    result["output_constraint"] = {{"curl_free", {{"position_states", spec.curl_free_positions}}}};
  }
  if (!spec.output_set.empty()) result["output_constraint"] = PolyhedronJson(spec.output_set);
  if (!spec.angles.states.empty()) result["angle_states"] = spec.angles.states;
  if (!spec.state_set.empty()) result["state_constraint"] = PolyhedronJson(spec.state_set);
  return result;
}

json ToJson(const LossSpec& spec) {
  json result = {{"rollout", NameOf(kRollouts, spec.rollout)},
                 {"stride", spec.stride},
                 {"output_weight", spec.output_weight},
                 {"state_weight", spec.state_weight},
                 {"reconstruction_weight", spec.reconstruction_weight}};
  if (spec.horizon == LossSpec::kWholeSet) {
    result["whole_set_horizon"] = true;
  } else {
    result["horizon"] = spec.horizon;
  }
  return result;
}

}  // namespace metaekf::nssm
