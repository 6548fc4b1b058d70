#include "core/nssm/predict.h"

#include <cmath>
#include <limits>
#include <map>

#include "core/autodiff/evaluate.h"
#include "core/base/status.h"
#include "core/nssm/start_fit.h"
#include "core/physics/projection.h"

namespace metaekf::nssm {
namespace {

using autodiff::Arena;
using autodiff::Executable;
using autodiff::Graph;
using autodiff::kNoValue;
using autodiff::Slots;
using autodiff::Value;
using Eigen::Index;
using Eigen::MatrixXd;

enum Slot : int32_t { kParameters, kStart, kInputs, kNextInputs, kOutputsOut, kStatesOut, kCarryOut };

constexpr Index kChunk = 4096;  // columns at a time: enough for wide products, little memory

template <typename T>
using MatrixT = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic>;

/// Runs a model's programs over one trajectory in normalised units.
template <typename T>
class Predictor {
 public:
  Predictor(const Bundle& bundle, const data::Trajectory& normalised)
      : bundle_(bundle),
        model_(bundle.model),
        spec_(model_.spec()),
        normalised_(normalised),
        parameters_(bundle.parameters.begin(), bundle.parameters.end()),
        u_(normalised.inputs.cast<T>()),
        y_(normalised.outputs.cast<T>()),
        x_(normalised.states.cast<T>()),
        length_(normalised.length()),
        warmup_(spec_.warmup()) {
    const double nan = std::numeric_limits<double>::quiet_NaN();
    result_.outputs = MatrixXd::Constant(spec_.output_size, length_, nan);
    result_.states = MatrixXd::Constant(spec_.state_size, length_, nan);
    result_.warmup = warmup_;
  }

  Prediction OneStep() {
    for (Index first = warmup_; first < length_; first += kChunk) {
      const Index width = std::min(kChunk, length_ - first);  // samples first … first + width − 1 are predicted
      const Compiled& step = OneStepProgram(static_cast<int32_t>(width));
      MatrixT<T> start(model_.start_size(), width);
      if (spec_.fits_start()) {
        start = FitLatents(first - 1, width);
      } else {
        for (Index j = 0; j < width; ++j) start.col(j) = Start(first + j - 1);
      }
      const Index shift = next_inputs() ? 1 : 0;
      const MatrixT<T> inputs = u_.middleCols(first - 1 + shift, width), next = u_.middleCols(first, width);
      MatrixT<T> y(spec_.output_size, width), x(spec_.state_size, width);
      Slots<T> slots = Bind(start, inputs, &y, &x);
      slots.Input(kNextInputs, next.data());
      autodiff::Evaluate(step.executable, slots, step.arena);
      result_.outputs.middleCols(first, width) = y.template cast<double>();
      result_.states.middleCols(first, width) = x.template cast<double>();
    }
    return result_;
  }

  Prediction Simulate() {
    // Case II carries x̂ and gives ŷ of the sample the carry belongs to, so it runs from sample 0 and overwrites
    // the measured start with its own output; Case I carries ψ and gives ŷ of the next sample.
    const bool case_one = spec_.is_case_one();
    MatrixT<T> carry = case_one ? EncodeWindow() : MatrixT<T>(x_.col(0));
    const Index begin = case_one ? warmup_ : 0;
    const Index input_shift = case_one ? (next_inputs() ? 0 : -1) : 0;
    for (Index first = begin; first < length_; first += kChunk) {
      const Index steps = std::min(kChunk, length_ - first);
      const Compiled& rollout = RolloutProgram(static_cast<int32_t>(steps));
      const MatrixT<T> inputs = u_.middleCols(first + input_shift, steps);
      MatrixT<T> y(spec_.output_size, steps), x(spec_.state_size, steps), next = carry;
      Slots<T> slots = Bind(carry, inputs, &y, &x);
      slots.Output(kCarryOut, next.data());
      autodiff::Evaluate(rollout.executable, slots, rollout.arena);
      carry = next;
      result_.outputs.middleCols(first, steps) = y.template cast<double>();
      const Index kept = std::min(steps, length_ - first - 1);  // x̂ of the sample after the last is not asked for
      if (!case_one) result_.states.middleCols(first + 1, kept) = x.leftCols(kept).template cast<double>();
    }
    if (!case_one) result_.outputs.col(0).setConstant(std::numeric_limits<double>::quiet_NaN());
    return result_;
  }

 private:
  struct Compiled {
    explicit Compiled(autodiff::Program program) : executable(std::move(program)), arena({&executable}) {}
    Executable<T> executable;
    Arena<T> arena;
  };

  bool next_inputs() const { return spec_.transition.input_time == InputTime::kNext; }

  /// What the encoder takes at sample t: the window ending there, or the state.
  MatrixT<T> Start(Index t) const {
    if (!spec_.is_case_one()) return x_.col(t);
    const Index rows = spec_.input_size + spec_.output_size;
    MatrixT<T> window(rows * warmup_, 1);
    for (Index s = 0; s < warmup_; ++s) {
      const Index sample = t - warmup_ + 1 + s;
      window.block(s * rows, 0, spec_.input_size, 1) = u_.col(sample);
      window.block(s * rows + spec_.input_size, 0, spec_.output_size, 1) = y_.col(sample);
    }
    return window;
  }

  Slots<T> Bind(const MatrixT<T>& start, const MatrixT<T>& inputs, MatrixT<T>* y, MatrixT<T>* x) const {
    Slots<T> slots;
    slots.Input(kParameters, parameters_.data())
        .Input(kStart, start.data())
        .Input(kInputs, inputs.data())
        .Output(kOutputsOut, y->data())
        .Output(kStatesOut, x->data());
    return slots;
  }

  /// ψ of samples first … first + count − 1 where the model has no encoder.
  MatrixT<T> FitLatents(Index first, Index count) const {
    StartFit fit(model_, *bundle_.prior, StartFit::WidthFor(count));
    Eigen::MatrixXd windows(model_.start_size(), count);
    for (Index j = 0; j < count; ++j) windows.col(j) = Stacked(first + j - warmup_ + 1);
    return fit.Fit(bundle_.parameters.data(), windows).template cast<T>();
  }

  /// The window that begins at sample `first`, in double.
  Eigen::VectorXd Stacked(Index first) const {
    MatrixXd window(spec_.input_size + spec_.output_size, warmup_);
    window.topRows(spec_.input_size) = normalised_.inputs.middleCols(first, warmup_);
    window.bottomRows(spec_.output_size) = normalised_.outputs.middleCols(first, warmup_);
    return window.reshaped();
  }

  MatrixT<T> EncodeWindow() const {
    if (spec_.fits_start()) return FitLatents(warmup_ - 1, 1);
    Graph graph;
    const nn::ParameterValues parameters = nn::BindParameters(model_.layout(), kParameters, &graph);
    const Value latent = ModelGraph(&model_, &graph, parameters)
                             .Encode(graph.Input(kStart, 0, model_.start_size(), 1), kNoValue);
    const Compiled encode(autodiff::Compile(graph, {{latent, kCarryOut}}));
    const MatrixT<T> window = Start(warmup_ - 1);
    MatrixT<T> result(spec_.latent_size, 1);
    Slots<T> slots;
    slots.Input(kParameters, parameters_.data()).Input(kStart, window.data()).Output(kCarryOut, result.data());
    autodiff::Evaluate(encode.executable, slots, encode.arena);
    return result;
  }

  const Compiled& OneStepProgram(int32_t width) {
    const auto found = programs_.find(width);
    if (found != programs_.end()) return found->second;
    Graph graph;
    const nn::ParameterValues parameters = nn::BindParameters(model_.layout(), kParameters, &graph);
    const ModelGraph parts(&model_, &graph, parameters);
    const bool has_inputs = spec_.input_size > 0;
    const Value start = graph.Input(kStart, 0, spec_.fits_start() ? spec_.latent_size : model_.start_size(), width);
    const Value inputs = has_inputs ? graph.Input(kInputs, 0, spec_.input_size, width) : kNoValue;
    const Value latent = parts.Advance(spec_.fits_start() ? start : parts.Encode(start, inputs), inputs);
    std::vector<autodiff::Output> outputs;
    if (spec_.is_case_one()) {
      outputs.push_back({parts.Output(latent, kNoValue), kOutputsOut});
    } else {
      const Value state = parts.State(latent);
      const Value next = has_inputs ? graph.Input(kNextInputs, 0, spec_.input_size, width) : kNoValue;
      outputs = {{parts.Output(parts.Encode(state, next), state), kOutputsOut}, {state, kStatesOut}};
    }
    return programs_.try_emplace(width, autodiff::Compile(graph, outputs)).first->second;
  }

  const Compiled& RolloutProgram(int32_t steps) {
    const auto found = programs_.find(steps);
    if (found != programs_.end()) return found->second;
    Graph graph;
    const nn::ParameterValues parameters = nn::BindParameters(model_.layout(), kParameters, &graph);
    const bool case_one = spec_.is_case_one();
    const Value carry = graph.Input(kStart, 0, case_one ? spec_.latent_size : spec_.state_size, 1);
    const Value inputs = spec_.input_size > 0 ? graph.Input(kInputs, 0, spec_.input_size, steps) : kNoValue;
    const Rollout rollout = BuildRollout(model_, case_one ? RolloutMode::kLatent : RolloutMode::kState, parameters,
                                         carry, inputs, steps, &graph);
    std::vector<autodiff::Output> outputs{{rollout.outputs, kOutputsOut}, {rollout.carry, kCarryOut}};
    if (!case_one) outputs.push_back({rollout.states, kStatesOut});
    return programs_.try_emplace(steps, autodiff::Compile(graph, outputs)).first->second;
  }

  const Bundle& bundle_;
  const Model& model_;
  const ModelSpec& spec_;
  const data::Trajectory& normalised_;
  const std::vector<T> parameters_;
  const MatrixT<T> u_, y_, x_;
  const Index length_, warmup_;
  Prediction result_;
  std::map<int32_t, Compiled> programs_;  // by columns or steps; a Predictor runs in one mode only
};

/// The layer of a constraint is exact but for rounding, in the model's precision; what is predicted is inside in double.
void PutInside(const physics::Polyhedron* set, MatrixXd* values) {
  if (set == nullptr) return;
  for (Index t = 0; t < values->cols(); ++t) {
    if (values->col(t).allFinite()) values->col(t) = physics::Inside(*set, values->col(t));
  }
}

template <typename T>
Prediction Run(const Bundle& bundle, const data::Trajectory& normalised, PredictionMode mode) {
  Predictor<T> predictor(bundle, normalised);
  return mode == PredictionMode::kOneStep ? predictor.OneStep() : predictor.Simulate();
}

}  // namespace

absl::StatusOr<Prediction> Predict(const Bundle& bundle, const data::Trajectory& trajectory, PredictionMode mode) {
  const ModelSpec& spec = bundle.model.spec();
  METAEKF_RETURN_IF_ERROR(CheckChannels(bundle, trajectory, !spec.is_case_one()));
  if (trajectory.length() <= spec.warmup()) {
    return absl::FailedPreconditionError(absl::StrCat("trajectory ", trajectory.name, ": ", trajectory.length(),
                                                      " samples are too few, the first prediction needs ",
                                                      spec.warmup() + 1));
  }
  data::Trajectory normalised;
  normalised.inputs = bundle.normaliser.inputs.Normalise(trajectory.inputs);
  normalised.outputs = bundle.normaliser.outputs.Normalise(trajectory.outputs);
  normalised.states = spec.is_case_one() ? MatrixXd(0, trajectory.length())
                                         : bundle.normaliser.states.Normalise(trajectory.states);
  Prediction prediction = spec.precision == Precision::kFloat32 ? Run<float>(bundle, normalised, mode)
                                                                : Run<double>(bundle, normalised, mode);
  prediction.outputs = bundle.normaliser.outputs.Denormalise(prediction.outputs);
  if (!spec.is_case_one()) prediction.states = bundle.normaliser.states.Denormalise(prediction.states);
  PutInside(bundle.model.output_set(), &prediction.outputs);
  PutInside(bundle.model.state_set(), &prediction.states);
  return prediction;
}

Score ScorePredictions(const std::vector<MatrixXd>& measured, const std::vector<MatrixXd>& predicted) {
  Score score;
  if (measured.empty()) return score;
  const Index channels = measured[0].rows();
  int64_t most = 0;
  for (Index i = 0; i < channels; ++i) {
    double sum = 0, squared_error = 0, squared_deviation = 0;
    int64_t count = 0;
    const auto for_each = [&](auto visit) {
      for (size_t k = 0; k < measured.size(); ++k) {
        for (Index t = 0; t < measured[k].cols(); ++t) {
          const double y = measured[k](i, t), y_hat = predicted[k](i, t);
          if (!std::isnan(y) && !std::isnan(y_hat)) visit(y, y_hat);
        }
      }
    };
    for_each([&](double y, double y_hat) {
      sum += y;
      squared_error += (y - y_hat) * (y - y_hat);
      ++count;
    });
    const double mean = count > 0 ? sum / static_cast<double>(count) : 0;
    for_each([&](double y, double) { squared_deviation += (y - mean) * (y - mean); });
    score.rmse.push_back(std::sqrt(squared_error / static_cast<double>(count)));
    score.fit_percent.push_back(100 * (1 - std::sqrt(squared_error / squared_deviation)));
    most = std::max(most, count);
  }
  score.samples = most;
  return score;
}

}  // namespace metaekf::nssm
