#include "core/nssm/loss.h"

#include <algorithm>

#include "core/autodiff/differentiate.h"
#include "core/autodiff/keep.h"
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
  kRecord,
  kLossOut,
  kVectorOut,
};

/// Multiplications of a rollout's parameters from which on threads are worth being woken, and rollout steps in a block that keep products
/// of matrices near their speed.
constexpr int64_t kLargeLoss = 1 << 22;
constexpr int64_t kBlockColumns = 32, kMostBlocks = 16;

/// How many rollouts each block has.
std::vector<int32_t> BlockSizes(const LossShape& shape, int64_t parameters) {
  const int64_t columns = int64_t{shape.rollouts} * shape.horizon;
  const int64_t most = columns * parameters < kLargeLoss ? 1 : std::min({columns / kBlockColumns, kMostBlocks, int64_t{shape.rollouts}});
  const int32_t blocks = static_cast<int32_t>(std::max<int64_t>(most, 1));
  std::vector<int32_t> sizes;
  for (int32_t b = 0; b < blocks; ++b) sizes.push_back(shape.rollouts / blocks + (b < shape.rollouts % blocks ? 1 : 0));
  return sizes;
}

/// Columns first … first + count − 1 of every step.
template <typename T>
void CopyColumns(const std::vector<T>& from, const LossShape& shape, int32_t steps, int32_t first, int32_t count, std::vector<T>* to) {
  const size_t width = static_cast<size_t>(shape.rollouts), rows = from.size() / (width * static_cast<size_t>(steps));
  to->clear();
  for (int32_t step = 0; step < steps; ++step) {
    const T* begin = from.data() + (static_cast<size_t>(step) * width + static_cast<size_t>(first)) * rows;
    to->insert(to->end(), begin, begin + static_cast<size_t>(count) * rows);
  }
}

/// Rollouts first … first + count − 1 of a set.
template <typename T>
void CopyRollouts(const LossData<T>& from, int32_t first, int32_t count, LossData<T>* to) {
  to->shape = {count, from.shape.horizon};
  for (const auto matrix : {&LossData<T>::start, &LossData<T>::first_input, &LossData<T>::first_output}) {
    CopyColumns(from.*matrix, from.shape, 1, first, count, &(to->*matrix));
  }
  for (const auto matrix : {&LossData<T>::inputs, &LossData<T>::states, &LossData<T>::outputs}) {
    CopyColumns(from.*matrix, from.shape, from.shape.horizon, first, count, &(to->*matrix));
  }
}

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
                              const nn::Mask& differentiated, const nn::Mask& along, HessianProducts products)
    : shape_(shape), size_(model.layout().size()) {
  const auto written = [&model](const nn::Mask& mask) {
    return Written{nn::PiecesOf(model.layout(), mask, true), nn::PiecesOf(model.layout(), mask, false)};
  };
  of_gradient_ = written(products == HessianProducts::kFromRecord ? along : differentiated);
  of_product_ = written(differentiated);
  int32_t first = 0, last_count = 0;
  for (const int32_t count : BlockSizes(shape, size_)) {
    if (count != last_count) programs_.push_back(Compile(model, loss, count, differentiated, along, products));
    blocks_.push_back({first, count, programs_.size() - 1, record_size_});
    first += count;
    last_count = count;
    record_size_ += programs_.back().record_size;
  }
}

template <typename T>
typename LossFunction<T>::Programs LossFunction<T>::Compile(const Model& model, const LossSpec& loss, int32_t rollouts,
                                                            const nn::Mask& differentiated, const nn::Mask& along, HessianProducts products) const {
  Graph graph;
  const nn::ParameterLayout& layout = model.layout();
  const nn::ParameterValues parameters = nn::BindParameters(layout, kParameters, &graph);
  const nn::ParameterValues directions = nn::BindParameters(layout, kDirection, &graph);
  const double share = static_cast<double>(rollouts) / shape_.rollouts;
  const autodiff::Value total = graph.Scale(BuildLoss(model, loss, {rollouts, shape_.horizon}, parameters, &graph), share);
  std::vector<autodiff::Value> wrt;
  std::vector<size_t> tensors;
  std::vector<autodiff::Seed> seeds;
  for (size_t i = 0; i < parameters.size(); ++i) {
    if (along[i]) seeds.push_back({parameters[i], directions[i]});
    if (!differentiated[i]) continue;
    wrt.push_back(parameters[i]);
    tensors.push_back(i);
  }
  autodiff::Executable<T> value(autodiff::Compile(graph, {{total, kLossOut}}));
  const std::vector<autodiff::Value> gradient = autodiff::Gradient(&graph, total, wrt);
  const bool records = products == HessianProducts::kFromRecord;
  std::vector<autodiff::Value> product;
  if (products != HessianProducts::kNone) product = autodiff::Jvp(&graph, seeds, gradient);
  std::vector<Output> gradient_outputs{{total, kLossOut}}, product_outputs;
  for (size_t i = 0; i < wrt.size(); ++i) {
    const int64_t offset = layout.tensors()[tensors[i]].offset;
    if (!records || along[tensors[i]]) gradient_outputs.push_back({gradient[i], kVectorOut, offset});
    if (product.empty()) continue;
    const autodiff::Node shape_of = graph.node(gradient[i]);
    if (product[i] == kNoValue) product[i] = graph.Constant(0, shape_of.rows, shape_of.cols);
    product_outputs.push_back({product[i], kVectorOut, offset});
  }
  std::vector<Output> kept;
  if (records) kept = autodiff::ValuesToKeep(graph, gradient_outputs, product_outputs, kRecord);
  gradient_outputs.insert(gradient_outputs.end(), kept.begin(), kept.end());
  autodiff::Executable<T> of_gradient(autodiff::Compile(graph, gradient_outputs));
  const int64_t record_size = autodiff::SizeOfKept(graph, kept);
  for (const Output& output : kept) graph.TurnIntoInput(output.value, output.slot, output.offset);
  return {std::move(value), std::move(of_gradient), autodiff::Executable<T>(autodiff::Compile(graph, product_outputs)), record_size};
}

template <typename T>
LossFunction<T>::Scratch::Scratch(std::initializer_list<const LossFunction*> users, base::Executor* executor) : executor_(executor) {
  size_t blocks = 0;
  std::vector<const autodiff::Executable<T>*> programs;
  for (const LossFunction* user : users) {
    blocks = std::max(blocks, user->blocks_.size());
    for (const Programs& own : user->programs_) programs.insert(programs.end(), {&own.value, &own.gradient, &own.hessian});
  }
  for (size_t i = 0; i < std::min(executor->concurrency(), blocks); ++i) arenas_.emplace_back(programs);
  losses_.resize(blocks);
  if (blocks == 1) return;
  data_.resize(blocks);
  vectors_.resize(blocks);
  for (size_t block = 1; block < blocks; ++block) vectors_[block].resize(static_cast<size_t>((*users.begin())->size_));
}

template <typename T>
double LossFunction<T>::RunBlocks(autodiff::Executable<T> Programs::*program, const T* parameters, const LossData<T>& data, const T* v,
                                  T* vector, T* record, Scratch* scratch) const {
  const auto run = [&](size_t block, const LossData<T>& of_block, T* to, size_t arena) {
    Slots<T> slots;
    slots.Input(kParameters, parameters)
        .Input(kStart, of_block.start.data())
        .Input(kFirstInput, of_block.first_input.data())
        .Input(kInputs, of_block.inputs.data())
        .Input(kStates, of_block.states.data())
        .Input(kOutputs, of_block.outputs.data())
        .Input(kFirstOutput, of_block.first_output.data())
        .Input(kDirection, v)
        .Output(kRecord, record == nullptr ? nullptr : record + blocks_[block].record)
        .Output(kLossOut, &scratch->losses_[block])
        .Output(kVectorOut, to);
    autodiff::Evaluate(programs_[blocks_[block].programs].*program, slots, scratch->arenas_[arena]);
  };
  const size_t blocks = blocks_.size();
  if (blocks == 1) {
    run(0, data, vector, 0);
  } else {
    scratch->executor_->ParallelFor(blocks, [&](size_t block, size_t slot) {
      CopyRollouts(data, blocks_[block].first, blocks_[block].count, &scratch->data_[block]);
      run(block, scratch->data_[block], block == 0 ? vector : scratch->vectors_[block].data(), scratch->arenas_.size() >= blocks ? block : slot);
    });
  }
  double sum = 0;
  for (size_t block = 0; block < blocks; ++block) sum += static_cast<double>(scratch->losses_[block]);
  return sum;
}

template <typename T>
void LossFunction<T>::AddBlocks(const Written& written, T* vector, Scratch* scratch) const {
  for (const auto& [offset, size] : written.rest) std::fill_n(vector + offset, size, T(0));
  if (blocks_.size() == 1) return;
  nn::ForParts(written.pieces, scratch->executor_, [&](size_t, int64_t begin, int64_t end) {
    for (size_t block = 1; block < blocks_.size(); ++block) {
      const T* const other = scratch->vectors_[block].data();
      for (int64_t i = begin; i < end; ++i) vector[i] += other[i];
    }
  });
}

template <typename T>
double LossFunction<T>::Value(const T* parameters, const LossData<T>& data, Scratch* scratch) const {
  return RunBlocks(&Programs::value, parameters, data, nullptr, nullptr, nullptr, scratch);
}

template <typename T>
double LossFunction<T>::Gradient(const T* parameters, const LossData<T>& data, T* gradient, Scratch* scratch, T* record) const {
  const double loss = RunBlocks(&Programs::gradient, parameters, data, nullptr, gradient, record, scratch);
  AddBlocks(of_gradient_, gradient, scratch);
  return loss;
}

template <typename T>
void LossFunction<T>::HessianVector(const T* parameters, const LossData<T>& data, const T* v, T* product, Scratch* scratch,
                                    const T* record) const {
  RunBlocks(&Programs::hessian, parameters, data, v, product, const_cast<T*>(record), scratch);
  AddBlocks(of_product_, product, scratch);
}

template LossData<float> CutLossData(const ModelSpec&, const LossSpec&, const data::Trajectory&, int64_t, const LossShape&);
template LossData<double> CutLossData(const ModelSpec&, const LossSpec&, const data::Trajectory&, int64_t, const LossShape&);
template class LossFunction<float>;
template class LossFunction<double>;

}  // namespace metaekf::nssm
