#include "core/nssm/loss.h"

#include <algorithm>

#include "core/autodiff/differentiate.h"
#include "core/base/status.h"

namespace metaekf::nssm {
namespace {

using autodiff::Graph;
using autodiff::kNoValue;
using autodiff::Output;
using autodiff::Slots;

enum Slot : int32_t {
  kParameters,
  kDirection,
  kStart,
  kFirstInput,
  kInputs,
  kStates,
  kOutputs,
  kFirstOutput,
  kLossOut,
  kVectorOut,
};

/// weight · mean((a − b)²)
autodiff::Value MeanSquaredError(Graph* graph, double weight, autodiff::Value a, autodiff::Value b) {
  const autodiff::Value difference = graph->Sub(a, b);
  const double size = static_cast<double>(graph->node(a).rows) * graph->node(a).cols;
  return graph->Scale(graph->Dot(difference, difference), weight / size);
}

autodiff::Value BuildLoss(const Model& model, const LossSpec& loss, const LossShape& shape,
                          const nn::ParameterValues& parameters, Graph* graph) {
  const ModelSpec& spec = model.spec();
  const int32_t width = shape.rollouts, columns = shape.rollouts * shape.horizon;
  const bool has_inputs = spec.input_size > 0;
  const autodiff::Value inputs = has_inputs ? graph->Input(kInputs, 0, spec.input_size, columns) : kNoValue;
  const autodiff::Value start = graph->Input(kStart, 0, model.start_size(), width);
  const autodiff::Value first_input = !has_inputs          ? kNoValue
                                      : shape.horizon == 1 ? inputs  // the same value, so that 𝓔 is computed once
                                                           : graph->Input(kFirstInput, 0, spec.input_size, width);
  const ModelGraph parts(&model, graph, parameters);
  const autodiff::Value carry = StartOfRollout(parts, loss.rollout, start, first_input);
  const Rollout rollout = BuildRollout(model, loss.rollout, parameters, carry, inputs, shape.horizon, graph);
  autodiff::Value total = kNoValue;
  const auto add_term = [&](double weight, autodiff::Value prediction, autodiff::Value target) {
    if (weight > 0) total = graph->AddOrEither(total, MeanSquaredError(graph, weight, prediction, target));
  };
  add_term(loss.output_weight, rollout.outputs, graph->Input(kOutputs, 0, spec.output_size, columns));
  if (!spec.is_case_one()) {
    add_term(loss.state_weight, rollout.states, graph->Input(kStates, 0, spec.state_size, columns));
  }
  if (loss.reconstruction_weight > 0) {
    const autodiff::Value latent = parts.Encode(start, first_input);
    if (spec.is_case_one()) {
      add_term(loss.reconstruction_weight, parts.Output(latent, kNoValue),
               graph->Input(kFirstOutput, 0, spec.output_size, width));
    } else {
      add_term(loss.reconstruction_weight, parts.State(latent), start);
    }
  }
  return total;
}

}  // namespace

int64_t SamplesNeeded(const ModelSpec& model, const LossSpec& loss) {
  if (model.fits_start()) return int64_t{model.warmup()} + 1;
  return int64_t{model.warmup()} + std::max<int64_t>(loss.horizon, 1);
}

absl::StatusOr<LossShape> ShapeOfLoss(const ModelSpec& model, const LossSpec& loss, int64_t samples) {
  const int64_t needed = SamplesNeeded(model, loss);
  if (samples < needed) {
    return absl::FailedPreconditionError(
        absl::StrCat("too few samples: ", samples, " given, at least ", needed, " needed (", model.warmup(),
                     model.is_case_one() ? " in the encoder's window" : " to start from", " and ",
                     std::max<int64_t>(loss.horizon, 1), " predicted)"));
  }
  if (loss.horizon == LossSpec::kWholeSet) return LossShape{1, static_cast<int32_t>(samples - model.warmup())};
  return LossShape{static_cast<int32_t>((samples - needed) / loss.stride + 1), loss.horizon};
}

template <typename T>
LossData<T> CutLossData(const ModelSpec& model, const LossSpec& loss, const data::Trajectory& normalised, int64_t first,
                        const LossShape& shape) {
  const int32_t n_u = model.input_size, n_y = model.output_size, n_x = model.state_size;
  LossData<T> data{.shape = shape};
  const auto append = [](const Eigen::MatrixXd& signal, int64_t t, std::vector<T>* to) {
    for (Eigen::Index i = 0; i < signal.rows(); ++i) to->push_back(static_cast<T>(signal(i, t)));
  };
  const int64_t warmup = model.warmup();
  const int64_t input_shift = model.transition.input_time == InputTime::kNext ? 1 : 0;
  const int64_t output_shift = model.is_case_one() ? 1 : 0;
  const size_t columns = static_cast<size_t>(shape.rollouts) * static_cast<size_t>(shape.horizon);
  data.inputs.reserve(columns * static_cast<size_t>(n_u));
  data.outputs.reserve(columns * static_cast<size_t>(n_y));
  data.states.reserve(columns * static_cast<size_t>(n_x));
  for (int32_t k = 0; k < shape.horizon; ++k) {
    for (int32_t j = 0; j < shape.rollouts; ++j) {
      const int64_t t = first + warmup - 1 + int64_t{j} * loss.stride;  // the sample that the rollout starts from
      if (k == 0) {
        if (model.is_case_one()) {
          for (int64_t s = t - warmup + 1; s <= t; ++s) {
            append(normalised.inputs, s, &data.start);
            append(normalised.outputs, s, &data.start);
          }
          append(normalised.outputs, t, &data.first_output);
        } else {
          append(normalised.states, t, &data.start);
        }
        append(normalised.inputs, t, &data.first_input);
      }
      append(normalised.inputs, t + k + input_shift, &data.inputs);
      append(normalised.outputs, t + k + output_shift, &data.outputs);
      if (!model.is_case_one()) append(normalised.states, t + k + 1, &data.states);
    }
  }
  return data;
}

template <typename T>
LossFunction<T>::LossFunction(const Model& model, const LossSpec& loss, const LossShape& shape,
                              const nn::Mask& differentiated, const nn::Mask& along)
    : shape_(shape) {
  Graph graph;
  const nn::ParameterLayout& layout = model.layout();
  const nn::ParameterValues parameters = nn::BindParameters(layout, kParameters, &graph);
  const nn::ParameterValues directions = nn::BindParameters(layout, kDirection, &graph);
  const autodiff::Value total = BuildLoss(model, loss, shape, parameters, &graph);
  std::vector<autodiff::Value> wrt;
  std::vector<int64_t> offsets;
  std::vector<autodiff::Seed> seeds;
  for (size_t i = 0; i < parameters.size(); ++i) {
    const nn::Tensor& tensor = layout.tensors()[i];
    if (along[i]) seeds.push_back({parameters[i], directions[i]});
    if (differentiated[i]) {
      wrt.push_back(parameters[i]);
      offsets.push_back(tensor.offset);
    } else {
      undifferentiated_.push_back({tensor.offset, tensor.size()});
    }
  }
  value_.emplace(autodiff::Compile(graph, {{total, kLossOut}}));
  const std::vector<autodiff::Value> gradient = autodiff::Gradient(&graph, total, wrt);
  std::vector<autodiff::Value> product = autodiff::Jvp(&graph, seeds, gradient);
  std::vector<Output> gradient_outputs{{total, kLossOut}}, product_outputs;
  for (size_t i = 0; i < wrt.size(); ++i) {
    const autodiff::Node shape_of = graph.node(gradient[i]);
    if (product[i] == kNoValue) product[i] = graph.Constant(0, shape_of.rows, shape_of.cols);
    gradient_outputs.push_back({gradient[i], kVectorOut, offsets[i]});
    product_outputs.push_back({product[i], kVectorOut, offsets[i]});
  }
  gradient_.emplace(autodiff::Compile(graph, gradient_outputs));
  hessian_.emplace(autodiff::Compile(graph, product_outputs));
}

template <typename T>
Slots<T> LossFunction<T>::Bind(const T* parameters, const LossData<T>& data) {
  Slots<T> slots;
  slots.Input(kParameters, parameters)
      .Input(kStart, data.start.data())
      .Input(kFirstInput, data.first_input.data())
      .Input(kInputs, data.inputs.data())
      .Input(kStates, data.states.data())
      .Input(kOutputs, data.outputs.data())
      .Input(kFirstOutput, data.first_output.data());
  return slots;
}

template <typename T>
void LossFunction<T>::ClearUndifferentiated(T* vector) const {
  for (const auto& [offset, size] : undifferentiated_) std::fill_n(vector + offset, size, T(0));
}

template <typename T>
double LossFunction<T>::Value(const T* parameters, const LossData<T>& data, const Scratch& scratch) const {
  T loss = 0;
  Slots<T> slots = Bind(parameters, data);
  autodiff::Evaluate(*value_, slots.Output(kLossOut, &loss), scratch);
  return static_cast<double>(loss);
}

template <typename T>
double LossFunction<T>::Gradient(const T* parameters, const LossData<T>& data, T* gradient, const Scratch& scratch) const {
  T loss = 0;
  Slots<T> slots = Bind(parameters, data);
  slots.Output(kLossOut, &loss).Output(kVectorOut, gradient);
  ClearUndifferentiated(gradient);
  autodiff::Evaluate(*gradient_, slots, scratch);
  return static_cast<double>(loss);
}

template <typename T>
void LossFunction<T>::HessianVector(const T* parameters, const LossData<T>& data, const T* v, T* product,
                                    const Scratch& scratch) const {
  Slots<T> slots = Bind(parameters, data);
  slots.Input(kDirection, v).Output(kVectorOut, product);
  ClearUndifferentiated(product);
  autodiff::Evaluate(*hessian_, slots, scratch);
}

template LossData<float> CutLossData(const ModelSpec&, const LossSpec&, const data::Trajectory&, int64_t, const LossShape&);
template LossData<double> CutLossData(const ModelSpec&, const LossSpec&, const data::Trajectory&, int64_t, const LossShape&);
template class LossFunction<float>;
template class LossFunction<double>;

}  // namespace metaekf::nssm
