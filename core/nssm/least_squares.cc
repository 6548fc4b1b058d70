#include "core/nssm/least_squares.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>

#include "core/autodiff/differentiate.h"
#include "core/autodiff/outer_products.h"
#include "core/linalg/products.h"

namespace metaekf::nssm {
namespace {

using autodiff::Graph;
using autodiff::kNoValue;
using autodiff::OuterProduct;
using autodiff::Output;
using autodiff::Slots;
using autodiff::Value;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

enum Slot : int32_t {
  kParameters,
  kStart,
  kFirstInput,
  kCarry,
  kInputs,
  kNextOut,
  kCarriesOut,
  kStatesOut,
  kOutputsOut,
  kByCarryOut,
  kByParametersOut,
};

// Columns at a time: enough for wide products, few enough that their Jacobians stay in the cache.
constexpr int32_t kColumns = 64;
constexpr int64_t kPanel = 256;  // rows of J that are squared at a time
constexpr int64_t kMostKept = int64_t{1} << 24;  // elements of J: 128 MiB

/// Component `row` of a value with `rows` rows: the cotangent that picks it in every column.
Value Pick(Graph* graph, int32_t row, int32_t rows, int32_t columns) {
  return graph->PadRows(graph->Constant(1, 1, columns), row, rows);
}

/// Appends the Jacobian with respect to the carry: of each of its components a block of columns.
void AddCarryJacobian(Graph* graph, Value value, Value carry, int64_t offset, std::vector<Output>* outputs) {
  const int32_t n = graph->node(carry).rows, columns = graph->node(carry).cols;
  std::vector<double> directions(static_cast<size_t>(n) * static_cast<size_t>(n) * static_cast<size_t>(columns), 0);
  for (int32_t i = 0; i < n; ++i) {
    for (int32_t t = 0; t < columns; ++t) {
      directions[(static_cast<size_t>(i) * static_cast<size_t>(columns) + static_cast<size_t>(t)) * static_cast<size_t>(n) +
                 static_cast<size_t>(i)] = 1;
    }
  }
  const Value seed = graph->ConstantData(std::move(directions), n, n * columns);
  Value tangent = autodiff::Jvp(graph, {{carry, seed}}, {value}, n)[0];
  if (tangent == kNoValue) tangent = graph->Constant(0, graph->node(value).rows, n * columns);
  outputs->push_back({tangent, kByCarryOut, offset});
}

}  // namespace

/// The Jacobian of a value with respect to the parameters: of each component its outer products.
class RolloutLeastSquares::Workspace::DirectJacobian {
 public:
  DirectJacobian(Graph* graph, const std::vector<Value>& wrt) : graph_(graph), wrt_(wrt) {}

  /// Appends the components of `value`, and to `outputs` what they are made of.
  void Add(Value value, std::vector<Output>* outputs) {
    const int32_t rows = graph_->node(value).rows, columns = graph_->node(value).cols;
    for (int32_t row = 0; row < rows; ++row) {
      const std::vector<Value> cotangents = autodiff::Vjp(graph_, {{value, Pick(graph_, row, rows, columns)}}, wrt_);
      components_.emplace_back();
      int64_t first = 0;
      for (size_t i = 0; i < wrt_.size(); ++i) {
        const autodiff::Node shape = graph_->node(wrt_[i]);
        if (cotangents[i] != kNoValue) {
          for (const OuterProduct& product : autodiff::OuterProducts(graph_, cotangents[i], columns)) {
            AddTerms(product, columns, first, shape.rows, outputs);
          }
        }
        first += int64_t{shape.rows} * shape.cols;
      }
    }
  }

  int64_t size() const { return size_; }

  /// The terms of every component, once the program's output stands at `values`.
  std::vector<std::vector<DirectTerm>> TermsAt(const double* values) const {
    std::vector<std::vector<DirectTerm>> result;
    for (const std::vector<Term>& component : components_) {
      result.emplace_back();
      for (const Term& t : component) {
        result.back().push_back({values + t.a, t.b < 0 ? nullptr : values + t.b, t.rows, t.cols, t.first, t.stride});
      }
    }
    return result;
  }

 private:
  /// As DirectTerm, with the places of a and b in the output.
  struct Term {
    int64_t a, b;
    size_t rows, cols, first, stride;
  };

  void AddTerms(const OuterProduct& product, int32_t columns, int64_t first, int32_t stride, std::vector<Output>* outputs) {
    const int32_t rows = graph_->node(product.a).rows;
    const int32_t cols = product.b == kNoValue ? 1 : graph_->node(product.b).rows;
    const int32_t directions = graph_->node(product.a).cols / columns;
    const int64_t a = PlaceOf(product.a, outputs), b = product.b == kNoValue ? -1 : PlaceOf(product.b, outputs);
    for (int64_t k = 0; k < directions; ++k) {
      components_.back().push_back({a + k * rows * columns, b < 0 ? b : b + k * cols * columns, static_cast<size_t>(rows),
                                    static_cast<size_t>(cols), static_cast<size_t>(first + product.first),
                                    static_cast<size_t>(stride)});
    }
  }

  int64_t PlaceOf(Value value, std::vector<Output>* outputs) {
    const auto [place, is_new] = places_.try_emplace(value, size_);
    if (is_new) {
      outputs->push_back({value, kByParametersOut, size_});
      size_ += int64_t{graph_->node(value).rows} * graph_->node(value).cols;
    }
    return place->second;
  }

  Graph* graph_;
  std::vector<Value> wrt_;
  std::vector<std::vector<Term>> components_;
  std::map<Value, int64_t> places_;  // what components share is written once
  int64_t size_ = 0;
};

RolloutLeastSquares::RolloutLeastSquares(const Model& model, const LossSpec& loss, const nn::Mask& mask, bool free_start)
    : model_(model), loss_(loss), free_start_(free_start), mode_(loss.rollout), mask_(mask) {
  const ModelSpec& spec = model.spec();
  carry_size_ = mode_ == RolloutMode::kLatent ? spec.latent_size : spec.state_size;
  state_channels_ = spec.is_case_one() ? 0 : spec.state_size;
  channels_ = state_channels_ + spec.output_size;
  for (size_t i = 0; i < mask.size(); ++i) {
    const nn::Tensor& tensor = model.layout().tensors()[i];
    if (!mask[i]) continue;
    adapted_.push_back({tensor.offset, tensor.size()});
    adapted_size_ += static_cast<int32_t>(tensor.size());
  }
}

absl::StatusOr<LossData<double>> RolloutLeastSquares::Cut(const data::Trajectory& normalised) const {
  if (!free_start_) {
    const absl::StatusOr<LossShape> shape = ShapeOfLoss(model_.spec(), loss_, normalised.length());
    if (!shape.ok()) return shape.status();
    return CutLossData<double>(model_.spec(), loss_, normalised, 0, *shape);
  }
  if (normalised.length() < 2) return absl::FailedPreconditionError("too few samples: at least 2 needed");
  // A free start needs no window: the set is cut as that of a model which starts from its first sample.
  ModelSpec spec = model_.spec();
  if (spec.is_case_one()) spec.window = 1;
  return CutLossData<double>(spec, loss_, normalised, 0, {1, static_cast<int32_t>(normalised.length() - 1)});
}

RolloutLeastSquares::Workspace::Workspace(const RolloutLeastSquares& owner, const LossShape& shape)
    : width_(std::min(shape.rollouts, kColumns)), steps_(std::min(shape.horizon, std::max(1, kColumns / width_))) {
  const Model& model = owner.model_;
  const ModelSpec& spec = model.spec();
  const int32_t n = owner.carry_size_, columns = width_ * steps_;
  const int32_t n_u = spec.input_size, unknowns = owner.unknowns();
  start_.setZero(model.start_size(), width_);
  first_input_.setZero(n_u, width_);
  inputs_.setZero(n_u, columns);
  carry_.setZero(n, width_);
  carries_.setZero(n, columns);
  next_.setZero(n, width_);
  channels_.setZero(owner.channels_, columns);
  const auto bind = [&](Graph* graph, std::vector<Value>* wrt) {
    nn::ParameterValues parameters = nn::BindParameters(model.layout(), kParameters, graph);
    for (size_t i = 0; i < parameters.size(); ++i) {
      if (owner.mask_[i]) wrt->push_back(parameters[i]);
    }
    return parameters;
  };
  const auto input = [&](Graph* graph, int32_t slot, int32_t cols) {
    return n_u > 0 ? graph->Input(slot, 0, n_u, cols) : kNoValue;
  };
  if (!owner.free_start_ && owner.mode_ == RolloutMode::kLatent) {
    Graph graph;
    std::vector<Value> wrt;
    const ModelGraph parts(&model, &graph, bind(&graph, &wrt));
    const Value latent =
        parts.Encode(graph.Input(kStart, 0, model.start_size(), width_), input(&graph, kFirstInput, width_));
    std::vector<Output> outputs{{latent, kNextOut}};
    DirectJacobian jacobian(&graph, wrt);
    jacobian.Add(latent, &outputs);
    encode_.emplace(autodiff::Compile(graph, outputs));
    by_parameters_of_start_.setZero(jacobian.size());
    start_terms_ = jacobian.TermsAt(by_parameters_of_start_.data());
  }
  {
    Graph graph;
    std::vector<Value> wrt;
    const nn::ParameterValues parameters = bind(&graph, &wrt);
    const Rollout rollout = BuildRollout(model, owner.mode_, parameters, graph.Input(kCarry, 0, n, width_),
                                         input(&graph, kInputs, columns), steps_, &graph);
    std::vector<Output> outputs{
        {rollout.carry, kNextOut}, {rollout.carries, kCarriesOut}, {rollout.outputs, kOutputsOut}};
    if (owner.state_channels_ > 0) outputs.push_back({rollout.states, kStatesOut});
    rollout_.emplace(autodiff::Compile(graph, outputs));
  }
  {
    Graph graph;
    std::vector<Value> wrt;
    const ModelGraph parts(&model, &graph, bind(&graph, &wrt));
    const Value carry = graph.Input(kCarry, 0, n, columns);
    const Step step = BuildStep(model, owner.mode_, parts, carry, input(&graph, kInputs, columns));
    std::vector<Output> outputs;
    DirectJacobian jacobian(&graph, wrt);
    int64_t by_carry = 0;
    const auto add = [&](Value value) {
      AddCarryJacobian(&graph, value, carry, by_carry, &outputs);
      by_carry += int64_t{graph.node(value).rows} * n * columns;
      jacobian.Add(value, &outputs);
    };
    add(step.next);
    if (owner.state_channels_ > 0) add(step.state);
    add(step.output);
    local_.emplace(autodiff::Compile(graph, outputs));
    by_carry_.setZero(by_carry);
    by_parameters_.setZero(jacobian.size());
    terms_ = jacobian.TermsAt(by_parameters_.data());
  }
  sensitivity_.setZero(unknowns, n * width_);
  next_sensitivity_.setZero(unknowns, n);
  factors_.setZero(n);
  const int64_t residuals = int64_t{shape.rollouts} * shape.horizon * owner.channels_;
  holds_all_ = unknowns * residuals <= kMostKept;
  kept_rows_ = holds_all_ ? residuals : std::max<int64_t>(kPanel, owner.channels_);
}

void RolloutLeastSquares::Encode(const double* parameters, const LossData<double>& data, int32_t first, int32_t count,
                                 Workspace* workspace) const {
  Workspace& w = *workspace;
  const Index rows = w.start_.rows(), n_u = w.first_input_.rows();
  std::copy_n(data.start.data() + first * rows, count * rows, w.start_.data());
  std::copy_n(data.first_input.data() + first * n_u, count * n_u, w.first_input_.data());
  Slots<double> slots;
  slots.Input(kParameters, parameters)
      .Input(kStart, w.start_.data())
      .Input(kFirstInput, w.first_input_.data())
      .Output(kNextOut, w.carry_.data())
      .Output(kByParametersOut, w.by_parameters_of_start_.data());
  autodiff::Evaluate(w.encode_->executable, slots, w.encode_->arena);
}

template <typename Visit>
void RolloutLeastSquares::ForEachPiece(const double* parameters, const VectorXd& start, const LossData<double>& data,
                                       Workspace* workspace, const Visit& visit) const {
  Workspace& w = *workspace;
  const int32_t rollouts = data.shape.rollouts, horizon = data.shape.horizon;
  const Index n_u = w.inputs_.rows();
  Slots<double> slots;
  slots.Input(kParameters, parameters)
      .Input(kCarry, w.carry_.data())
      .Input(kInputs, w.inputs_.data())
      .Output(kNextOut, w.next_.data())
      .Output(kCarriesOut, w.carries_.data());
  MatrixXd states(state_channels_, w.inputs_.cols()), outputs(channels_ - state_channels_, w.inputs_.cols());
  slots.Output(kStatesOut, states.data()).Output(kOutputsOut, outputs.data());
  for (int32_t first = 0; first < rollouts; first += w.width_) {
    const int32_t count = std::min(w.width_, rollouts - first);
    if (free_start_) {
      w.carry_.col(0) = start;
    } else if (mode_ == RolloutMode::kLatent) {
      Encode(parameters, data, first, count, workspace);
    } else {
      std::copy_n(data.start.data() + first * carry_size_, count * carry_size_, w.carry_.data());
    }
    for (int32_t step = 0; step < horizon; step += w.steps_) {
      const int32_t steps = std::min(w.steps_, horizon - step);
      for (int32_t k = 0; k < steps; ++k) {
        std::copy_n(data.inputs.data() + (int64_t{step + k} * rollouts + first) * n_u, count * n_u,
                    w.inputs_.data() + int64_t{k} * w.width_ * n_u);
      }
      autodiff::Evaluate(w.rollout_->executable, slots, w.rollout_->arena);
      w.channels_.topRows(state_channels_) = states;
      w.channels_.bottomRows(channels_ - state_channels_) = outputs;
      if (!visit(step, steps, first, count)) return;
      w.carry_ = w.next_;
    }
  }
}

double RolloutLeastSquares::Residual(const LossData<double>& data, int32_t channel, int64_t column,
                                     double prediction) const {
  const double target = channel < state_channels_
                            ? data.states[static_cast<size_t>(column * state_channels_ + channel)]
                            : data.outputs[static_cast<size_t>(column * (channels_ - state_channels_) + channel - state_channels_)];
  return prediction - target;
}

double RolloutLeastSquares::Cost(const double* parameters, const VectorXd& start, const VectorXd& weights,
                                 const LossData<double>& data, Workspace* workspace, VectorXd* channel_squares) const {
  VectorXd squares = VectorXd::Zero(channels_);
  ForEachPiece(parameters, start, data, workspace, [&](int32_t step, int32_t steps, int32_t first, int32_t count) {
    for (int32_t k = 0; k < steps; ++k) {
      for (int32_t j = 0; j < count; ++j) {
        const int64_t column = int64_t{step + k} * data.shape.rollouts + first + j;
        for (int32_t c = 0; c < channels_; ++c) {
          const double r = Residual(data, c, column, workspace->channels_(c, k * workspace->width_ + j));
          squares[c] += r * r;
        }
      }
    }
    return squares.allFinite();
  });
  if (channel_squares != nullptr) *channel_squares = squares;
  const double cost = 0.5 * weights.dot(squares);
  return std::isfinite(cost) ? cost : std::numeric_limits<double>::infinity();
}

void RolloutLeastSquares::Linearise(const double* parameters, const VectorXd& start, const VectorXd& weights,
                                    const LossData<double>& data, Workspace* workspace, NormalEquations* result) const {
  Workspace& w = *workspace;
  const int32_t n = carry_size_, q = channels_, all = unknowns();
  const int64_t columns = w.inputs_.cols();
  result->cost = 0;
  result->channel_squares.setZero(q);
  result->gradient.setZero(all);
  result->curvature.setZero(all, all);
  const VectorXd root = weights.cwiseSqrt();
  Slots<double> slots;
  slots.Input(kParameters, parameters)
      .Input(kCarry, w.carries_.data())
      .Input(kInputs, w.inputs_.data())
      .Output(kByCarryOut, w.by_carry_.data())
      .Output(kByParametersOut, w.by_parameters_.data());
  // Each value's Jacobian by the carry is rows × (n · columns).
  const double* by_carry_next = w.by_carry_.data();
  const double* by_carry_channels = by_carry_next + int64_t{n} * n * columns;
  const auto by_carry = [&](int32_t component, int32_t carry, int64_t column) {
    if (component < n) return by_carry_next[(carry * columns + column) * n + component];
    const int32_t channel = component - n, outputs = q - state_channels_;
    if (channel < state_channels_) return by_carry_channels[(carry * columns + column) * state_channels_ + channel];
    return by_carry_channels[int64_t{state_channels_} * n * columns + (carry * columns + column) * outputs + channel -
                             state_channels_];
  };
  const auto propagate = [&](int32_t carries, const double* sensitivity, const std::vector<DirectTerm>& terms, int64_t column,
                             double scale, double* target) {
    PropagateSensitivity(static_cast<size_t>(all), static_cast<size_t>(carries), sensitivity, w.factors_.data(), terms.data(),
                         terms.size(), static_cast<size_t>(column), scale, target);
  };
  if (w.rows_.size() == 0) {
    w.rows_.setZero(all, w.kept_rows_);
    w.residuals_.setZero(w.kept_rows_);
  }
  int64_t rows = 0, squared = 0;
  const auto square = [&] {
    linalg::AddSquare(all, static_cast<int32_t>(rows - squared), w.rows_.col(squared).data(), all, result->curvature.data(), all);
    result->gradient.noalias() += w.rows_.middleCols(squared, rows - squared) * w.residuals_.segment(squared, rows - squared);
    squared = rows;
    if (!w.holds_all_) rows = squared = 0;
  };
  ForEachPiece(parameters, start, data, workspace, [&](int32_t step, int32_t steps, int32_t first, int32_t count) {
    if (step == 0) {
      w.sensitivity_.setZero();
      if (free_start_) w.sensitivity_.bottomRows(n).setIdentity();
      if (!free_start_ && mode_ == RolloutMode::kLatent) {  // Encode has just written ∂𝓔/∂ω
        for (int32_t i = 0; i < n; ++i) {
          for (int32_t j = 0; j < count; ++j) {
            propagate(0, w.sensitivity_.data(), w.start_terms_[static_cast<size_t>(i)], j, 1, w.sensitivity_.col(j * n + i).data());
          }
        }
      }
    }
    autodiff::Evaluate(w.local_->executable, slots, w.local_->arena);
    for (int32_t k = 0; k < steps; ++k) {
      for (int32_t j = 0; j < count; ++j) {
        const int64_t local = int64_t{k} * w.width_ + j, column = int64_t{step + k} * data.shape.rollouts + first + j;
        auto sensitivity = w.sensitivity_.middleCols(j * n, n);
        const auto derivative = [&](int32_t component, double scale, double* target) {
          for (int32_t i = 0; i < n; ++i) w.factors_[i] = scale * by_carry(component, i, local);
          propagate(n, sensitivity.data(), w.terms_[static_cast<size_t>(component)], local, scale, target);
        };
        for (int32_t c = 0; c < q; ++c) {
          if (weights[c] == 0) continue;
          const double r = Residual(data, c, column, w.channels_(c, local));
          result->channel_squares[c] += r * r;
          derivative(n + c, root[c], w.rows_.col(rows).data());
          w.residuals_[rows++] = root[c] * r;
          if (rows - squared == kPanel || rows == w.rows_.cols()) square();
        }
        for (int32_t i = 0; i < n; ++i) derivative(i, 1, w.next_sensitivity_.col(i).data());
        sensitivity = w.next_sensitivity_;
      }
    }
    return true;
  });
  if (rows > squared) square();
  result->cost = 0.5 * weights.dot(result->channel_squares);
}

std::optional<VectorXd> RolloutLeastSquares::Bend(const double* parameters, const VectorXd& start, double h,
                                                  const VectorXd& direction, const VectorXd& weights,
                                                  const LossData<double>& data, Workspace* workspace) const {
  Workspace& w = *workspace;
  if (!w.holds_all_) return std::nullopt;
  const VectorXd root = weights.cwiseSqrt();
  VectorXd moved(w.residuals_.size());
  Index rows = 0;
  ForEachPiece(parameters, start, data, workspace, [&](int32_t step, int32_t steps, int32_t first, int32_t count) {
    for (int32_t k = 0; k < steps; ++k) {
      for (int32_t j = 0; j < count; ++j) {
        const int64_t column = int64_t{step + k} * data.shape.rollouts + first + j;
        for (int32_t c = 0; c < channels_; ++c) {
          if (weights[c] != 0) moved[rows++] = root[c] * Residual(data, c, column, w.channels_(c, k * w.width_ + j));
        }
      }
    }
    return true;
  });
  const auto jacobian = w.rows_.leftCols(rows);
  // r(x + h δ) = r + h J δ + ½ h² r″ + …
  const VectorXd bend = (2 / (h * h)) * (moved.head(rows) - w.residuals_.head(rows) - h * (jacobian.transpose() * direction));
  if (!bend.allFinite()) return std::nullopt;
  return jacobian * bend;
}

MatrixXd RolloutLeastSquares::Predictions(const double* parameters, const VectorXd& start, const LossData<double>& data,
                                          Workspace* workspace) const {
  MatrixXd predictions(channels_, Index{data.shape.horizon} * data.shape.rollouts);
  ForEachPiece(parameters, start, data, workspace, [&](int32_t step, int32_t steps, int32_t first, int32_t count) {
    for (int32_t k = 0; k < steps; ++k) {
      predictions.middleCols(Index{step + k} * data.shape.rollouts + first, count) =
          workspace->channels_.middleCols(Index{k} * workspace->width_, count);
    }
    return true;
  });
  return predictions;
}

MatrixXd RolloutLeastSquares::Carries(const double* parameters, const VectorXd& start, const LossData<double>& data,
                                      Workspace* workspace) const {
  MatrixXd carries(carry_size_, data.shape.horizon + 1);
  ForEachPiece(parameters, start, data, workspace, [&](int32_t step, int32_t steps, int32_t, int32_t) {
    carries.middleCols(step, steps) = workspace->carries_.leftCols(steps);
    carries.col(step + steps) = steps == workspace->steps_ ? workspace->next_.col(0) : workspace->carries_.col(steps);
    return true;
  });
  return carries;
}

}  // namespace metaekf::nssm
