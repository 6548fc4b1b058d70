#include "core/nssm/linearise.h"

#include "core/autodiff/differentiate.h"
#include "core/autodiff/evaluate.h"

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
using Eigen::VectorXd;

enum Slot : int32_t { kParameters, kParametersDirection, kCarry, kCarryDirection, kInput, kInputDirection, kValue, kTangent };

/// A function of parameters, carry and input with its derivative along one direction.
class Directional {
 public:
  /// @param build  makes the value from (graph, parameters, carry, input).
  template <typename Build>
  Directional(const Model& model, Index carry_size, Index input_columns, const Build& build) {
    const nn::ParameterLayout& layout = model.layout();
    const int32_t n = static_cast<int32_t>(carry_size), n_u = model.spec().input_size;
    const int32_t columns = static_cast<int32_t>(input_columns);
    const nn::ParameterValues parameters = nn::BindParameters(layout, kParameters, &graph_);
    const nn::ParameterValues directions = nn::BindParameters(layout, kParametersDirection, &graph_);
    const Value carry = graph_.Input(kCarry, 0, n, 1);
    const Value input = n_u > 0 ? graph_.Input(kInput, 0, n_u, columns) : kNoValue;
    std::vector<autodiff::Seed> seeds{{carry, graph_.Input(kCarryDirection, 0, n, 1)}};
    for (size_t i = 0; i < parameters.size(); ++i) seeds.push_back({parameters[i], directions[i]});
    if (n_u > 0) seeds.push_back({input, graph_.Input(kInputDirection, 0, n_u, columns)});
    const Value value = build(&graph_, parameters, carry, input);
    Value tangent = autodiff::Jvp(&graph_, seeds, {value})[0];
    const autodiff::Node shape = graph_.node(value);
    if (tangent == kNoValue) tangent = graph_.Constant(0, shape.rows, shape.cols);
    rows_ = Index{shape.rows} * shape.cols;
    executable_ = std::make_unique<Executable<double>>(autodiff::Compile(graph_, {{value, kValue}, {tangent, kTangent}}));
    arena_ = std::make_unique<Arena<double>>(std::initializer_list<const Executable<double>*>{executable_.get()});
    parameters_direction_.assign(static_cast<size_t>(layout.size()), 0.0);
    carry_direction_ = VectorXd::Zero(n);
    input_direction_ = MatrixXd::Zero(n_u, columns);
  }

  /// What is pointed to must outlive the use of this.
  void SetPoint(const double* parameters, const double* carry, const double* input) {
    slots_.Input(kParameters, parameters)
        .Input(kParametersDirection, parameters_direction_.data())
        .Input(kCarry, carry)
        .Input(kCarryDirection, carry_direction_.data())
        .Input(kInput, input)
        .Input(kInputDirection, input_direction_.data());
  }

  /// The derivative with respect to one element of a direction vector, which is zero before and after.
  VectorXd Along(double* element) {
    *element = 1;
    VectorXd tangent(rows_);
    value_.resize(rows_);
    slots_.Output(kValue, value_.data()).Output(kTangent, tangent.data());
    autodiff::Evaluate(*executable_, slots_, *arena_);
    *element = 0;
    return tangent;
  }

  MatrixXd AlongCarry() {
    MatrixXd jacobian(rows_, carry_direction_.size());
    for (Index i = 0; i < jacobian.cols(); ++i) jacobian.col(i) = Along(&carry_direction_[i]);
    return jacobian;
  }
  MatrixXd AlongInput() {
    MatrixXd jacobian(rows_, input_direction_.size());
    for (Index i = 0; i < jacobian.cols(); ++i) jacobian.col(i) = Along(input_direction_.data() + i);
    return jacobian;
  }
  MatrixXd AlongParameters(const nn::ParameterLayout& layout, const nn::Mask& mask) {
    std::vector<VectorXd> columns;
    for (size_t t = 0; t < mask.size(); ++t) {
      const nn::Tensor& tensor = layout.tensors()[t];
      for (int64_t i = 0; mask[t] && i < tensor.size(); ++i) {
        columns.push_back(Along(&parameters_direction_[static_cast<size_t>(tensor.offset + i)]));
      }
    }
    MatrixXd jacobian(rows_, static_cast<Index>(columns.size()));
    for (size_t i = 0; i < columns.size(); ++i) jacobian.col(static_cast<Index>(i)) = columns[i];
    return jacobian;
  }
  /// The value at the point, after any of the above.
  const VectorXd& value() const { return value_; }

 private:
  Graph graph_;
  Index rows_ = 0;
  std::unique_ptr<Executable<double>> executable_;
  std::unique_ptr<Arena<double>> arena_;
  Slots<double> slots_;
  std::vector<double> parameters_direction_;
  VectorXd carry_direction_, value_;
  MatrixXd input_direction_;
};

}  // namespace

Linearisation Linearise(const Model& model, const std::vector<double>& parameters, const VectorXd& state,
                        const VectorXd& input) {
  const bool case_one = model.spec().is_case_one();
  Directional f(model, state.size(), 1, [&](Graph* graph, const nn::ParameterValues& p, Value x, Value u) {
    const ModelGraph parts(&model, graph, p);
    return case_one ? parts.Advance(x, u) : parts.State(parts.Advance(parts.Encode(x, u), u));
  });
  Directional h(model, state.size(), 1, [&](Graph* graph, const nn::ParameterValues& p, Value x, Value u) {
    const ModelGraph parts(&model, graph, p);
    return case_one ? parts.Output(x, kNoValue) : parts.Output(parts.Encode(x, u), x);
  });
  f.SetPoint(parameters.data(), state.data(), input.data());
  h.SetPoint(parameters.data(), state.data(), input.data());
  Linearisation result{.A = f.AlongCarry(), .B = f.AlongInput(), .C = h.AlongCarry(), .D = h.AlongInput()};
  result.f = f.value();
  result.h = h.value();
  return result;
}

RolloutSensitivity DifferentiateRollout(const Model& model, RolloutMode mode, const std::vector<double>& parameters,
                                        const nn::Mask& mask, const VectorXd& carry, const MatrixXd& inputs) {
  const int32_t length = static_cast<int32_t>(inputs.cols());
  Directional rollout(model, carry.size(), inputs.cols(),
                      [&](Graph* graph, const nn::ParameterValues& p, Value c, Value u) {
                        return BuildRollout(model, mode, p, c, u, length, graph).outputs;
                      });
  rollout.SetPoint(parameters.data(), carry.data(), inputs.data());
  RolloutSensitivity result{.parameters = rollout.AlongParameters(model.layout(), mask), .carry = rollout.AlongCarry()};
  result.outputs = rollout.value();
  return result;
}

}  // namespace metaekf::nssm
