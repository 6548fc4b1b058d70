#include "core/filter/filter_model.h"

#include <algorithm>

#include "core/autodiff/differentiate.h"
#include "core/autodiff/evaluate.h"
#include "core/filter/unknown_directions.h"
#include "core/nssm/start_fit.h"

namespace metaekf::filter {
namespace {

using autodiff::Arena;
using autodiff::Executable;
using autodiff::Graph;
using autodiff::kNoValue;
using autodiff::Slots;
using autodiff::Value;
using Eigen::MatrixXd;
using Eigen::VectorXd;

enum Slot : int32_t { kParameters, kState, kInput, kDirection, kValueOut, kJacobianOut };

/// A function of state and input: its value with the Jacobian by the state, and its derivative along one direction of the parameters.
struct Programs {
  autodiff::Program transition, measurement, reconstruction, encode;
  autodiff::Program transition_along, measurement_along, reconstruction_along;
};

/// value(x, u) and its derivative along every component of x at once.
autodiff::Program WithJacobian(Graph* graph, Value value, Value state) {
  const int32_t n = graph->node(state).rows;
  std::vector<double> identity(static_cast<size_t>(n) * static_cast<size_t>(n), 0);
  for (int32_t i = 0; i < n; ++i) identity[static_cast<size_t>(i) * static_cast<size_t>(n + 1)] = 1;
  Value jacobian = autodiff::Jvp(graph, {{state, graph->ConstantData(std::move(identity), n, n)}}, {value}, n)[0];
  if (jacobian == kNoValue) jacobian = graph->Constant(0, graph->node(value).rows, n);
  return autodiff::Compile(*graph, {{value, kValueOut}, {jacobian, kJacobianOut}});
}

Programs BuildPrograms(const nssm::Model& model, int32_t n) {
  const nssm::ModelSpec& spec = model.spec();
  const auto build = [&](const auto& function, autodiff::Program* with_jacobian, autodiff::Program* along) {
    for (const bool by_parameters : {false, true}) {
      Graph graph;
      const nn::ParameterValues parameters = nn::BindParameters(model.layout(), kParameters, &graph);
      const nssm::ModelGraph parts(&model, &graph, parameters);
      const Value state = graph.Input(kState, 0, n, 1);
      const Value value = function(parts, state, spec.input_size > 0 ? graph.Input(kInput, 0, spec.input_size, 1) : kNoValue);
      if (!by_parameters) {
        *with_jacobian = WithJacobian(&graph, value, state);
        continue;
      }
      const nn::ParameterValues direction = nn::BindParameters(model.layout(), kDirection, &graph);
      std::vector<autodiff::Seed> seeds;
      for (size_t i = 0; i < parameters.size(); ++i) seeds.push_back({parameters[i], direction[i]});
      Value tangent = autodiff::Jvp(&graph, seeds, {value})[0];
      if (tangent == kNoValue) tangent = graph.Constant(0, graph.node(value).rows, 1);
      *along = autodiff::Compile(graph, {{tangent, kValueOut}});
    }
  };
  using Parts = nssm::ModelGraph;
  Programs programs;
  build([&](const Parts& parts, Value state, Value input) {
    return spec.is_case_one() ? parts.Advance(state, input) : parts.State(parts.Advance(parts.Encode(state, input), input));
  }, &programs.transition, &programs.transition_along);
  build([&](const Parts& parts, Value state, Value input) {
    return spec.is_case_one() ? parts.Output(state, kNoValue) : parts.Output(parts.Encode(state, input), state);
  }, &programs.measurement, &programs.measurement_along);
  if (!spec.is_case_one()) {
    build([&](const Parts& parts, Value state, Value input) { return parts.State(parts.Encode(state, input)); },
          &programs.reconstruction, &programs.reconstruction_along);
  }
  if (spec.is_case_one() && !spec.fits_start()) {
    Graph graph;
    const nssm::ModelGraph parts(&model, &graph, nn::BindParameters(model.layout(), kParameters, &graph));
    const Value window = graph.Input(kState, 0, model.start_size(), 1);
    programs.encode = autodiff::Compile(graph, {{parts.Encode(window, kNoValue), kValueOut}});
  }
  return programs;
}

template <typename T>
class TypedFilterModel : public FilterModel {
 public:
  TypedFilterModel(Programs programs, const nssm::Bundle& bundle, int32_t state_size)
      : model_(bundle.model),
        transition_(std::move(programs.transition)),
        measurement_(std::move(programs.measurement)),
        reconstruction_(std::move(programs.reconstruction)),
        encode_(std::move(programs.encode)),
        transition_along_(std::move(programs.transition_along)),
        measurement_along_(std::move(programs.measurement_along)),
        reconstruction_along_(std::move(programs.reconstruction_along)),
        argument_size_(std::max<int64_t>(state_size, model_.start_size())),
        input_size_(model_.spec().input_size),
        value_size_(std::max(state_size, model_.spec().output_size)) {
    state_size_ = state_size;
    if (model_.spec().fits_start()) prior_ = bundle.prior;
  }

  std::unique_ptr<Parameters> Prepare(const std::vector<double>& parameters, const MatrixXd& directions) const override {
    auto typed = std::make_unique<TypedParameters>(directions);
    typed->values.assign(parameters.begin(), parameters.end());
    if (prior_) typed->exact = parameters;
    return typed;
  }

  std::unique_ptr<Scratch> MakeScratch() const override { return std::make_unique<TypedScratch>(*this); }

  void Transition(const Parameters& parameters, const Eigen::Ref<const VectorXd>& x, const Eigen::Ref<const VectorXd>& u, VectorXd* f, MatrixXd* F,
                  Scratch* scratch) const override {
    Run(transition_, transition_along_, state_size_, parameters, x, u, f, F, scratch);
  }

  void Measurement(const Parameters& parameters, const Eigen::Ref<const VectorXd>& x, const Eigen::Ref<const VectorXd>& u, VectorXd* h, MatrixXd* H,
                   Scratch* scratch) const override {
    Run(measurement_, measurement_along_, model_.spec().output_size, parameters, x, u, h, H, scratch);
  }

  void Reconstruct(const Parameters& parameters, const Eigen::Ref<const VectorXd>& x, const Eigen::Ref<const VectorXd>& u,
                   VectorXd* reconstruction, MatrixXd* J, Scratch* scratch) const override {
    Run(reconstruction_, reconstruction_along_, state_size_, parameters, x, u, reconstruction, J, scratch);
  }

  void Encode(const Parameters& parameters, const Eigen::Ref<const VectorXd>& window, VectorXd* latent, Scratch* scratch) const override {
    if (!prior_) return Run(encode_, encode_, latent->size(), parameters, window, VectorXd(), latent, nullptr, scratch);
    TypedScratch& s = static_cast<TypedScratch&>(*scratch);
    s.window = window;
    *latent = s.start_fit->Fit(static_cast<const TypedParameters&>(parameters).exact.data(), s.window).col(0);
  }

  MatrixXd EncodedCovariance(const Scratch& scratch) const override {
    return static_cast<const TypedScratch&>(scratch).start_fit->Covariance();
  }

 private:
  struct TypedParameters : Parameters {
    explicit TypedParameters(const MatrixXd& unknown) : along(unknown.template cast<T>()) { directions_ = unknown.cols(); }
    std::vector<T> values;
    Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic> along;  // V
    std::vector<double> exact;  // for StartFit
  };
  struct TypedScratch : Scratch {
    explicit TypedScratch(const TypedFilterModel& owner)
        : arena({&owner.transition_, &owner.measurement_, &owner.reconstruction_, &owner.encode_, &owner.transition_along_,
                 &owner.measurement_along_, &owner.reconstruction_along_}),
          parameters(owner.model_.layout().size()),
          state(static_cast<size_t>(owner.argument_size_)),
          input(static_cast<size_t>(owner.input_size_)),
          value(static_cast<size_t>(owner.value_size_)),
          jacobian(static_cast<size_t>(owner.value_size_) * static_cast<size_t>(owner.state_size_)) {
      if (!owner.prior_) return;
      start_fit.emplace(owner.model_, *owner.prior_, 1);
      window.resize(owner.model_.start_size(), 1);
    }
    Arena<T> arena;
    Eigen::Matrix<T, Eigen::Dynamic, 1> parameters;  // ω̂ + V z
    std::vector<T> state, input, value, jacobian;
    std::optional<nssm::StartFit> start_fit;
    MatrixXd window;
  };

  /// Value and Jacobian, the latter by z too where the state comes with it. @param rows  of the program's results: the first of these.
  void Run(const Executable<T>& executable, const Executable<T>& along, Eigen::Index rows, const Parameters& parameters, const Eigen::Ref<const VectorXd>& x,
           const Eigen::Ref<const VectorXd>& u, VectorXd* value, MatrixXd* jacobian, Scratch* scratch) const {
    TypedScratch& s = static_cast<TypedScratch&>(*scratch);
    const TypedParameters& typed = static_cast<const TypedParameters&>(parameters);
    const Eigen::Index n = state_size_, r = jacobian == nullptr ? 0 : x.size() - n;
    for (Eigen::Index i = 0; i < x.size() - r; ++i) s.state[static_cast<size_t>(i)] = static_cast<T>(x[i]);
    for (Eigen::Index i = 0; i < u.size(); ++i) s.input[static_cast<size_t>(i)] = static_cast<T>(u[i]);
    const T* omega = typed.values.data();
    if (r > 0) {
      s.parameters = Eigen::Map<const Eigen::Matrix<T, Eigen::Dynamic, 1>>(omega, s.parameters.size());
      for (Eigen::Index k = 0; k < r; ++k) s.parameters += static_cast<T>(x[n + k]) * typed.along.col(k);
      omega = s.parameters.data();
    }
    Slots<T> slots;
    slots.Input(kParameters, omega)
        .Input(kState, s.state.data())
        .Input(kInput, s.input.data())
        .Output(kValueOut, s.value.data())
        .Output(kJacobianOut, s.jacobian.data());
    autodiff::Evaluate(executable, slots, s.arena);
    for (Eigen::Index i = 0; i < rows; ++i) (*value)[i] = static_cast<double>(s.value[static_cast<size_t>(i)]);
    if (jacobian == nullptr) return;
    for (Eigen::Index k = 0; k < n; ++k) {
      for (Eigen::Index i = 0; i < rows; ++i) (*jacobian)(i, k) = static_cast<double>(s.jacobian[static_cast<size_t>(k * rows + i)]);
    }
    for (Eigen::Index k = 0; k < r; ++k) {
      slots.Input(kDirection, typed.along.col(k).data());
      autodiff::Evaluate(along, slots, s.arena);
      for (Eigen::Index i = 0; i < rows; ++i) (*jacobian)(i, n + k) = static_cast<double>(s.value[static_cast<size_t>(i)]);
    }
  }

  const nssm::Model model_;
  std::optional<nssm::GaussianPrior> prior_;
  Executable<T> transition_, measurement_, reconstruction_, encode_, transition_along_, measurement_along_, reconstruction_along_;
  int64_t argument_size_;
  int32_t input_size_, value_size_;
};

}  // namespace

std::unique_ptr<FilterModel::Parameters> FilterModel::Prepare(const nssm::Bundle& bundle) const {
  return Prepare(bundle.parameters, UnknownDirections(bundle));
}

std::unique_ptr<FilterModel> FilterModel::Create(const nssm::Bundle& bundle) {
  const nssm::Model& model = bundle.model;
  const nssm::ModelSpec& spec = model.spec();
  const int32_t n = spec.is_case_one() ? spec.latent_size : spec.state_size;
  Programs programs = BuildPrograms(model, n);
  if (spec.precision == nssm::Precision::kFloat32) {
    return std::make_unique<TypedFilterModel<float>>(std::move(programs), bundle, n);
  }
  return std::make_unique<TypedFilterModel<double>>(std::move(programs), bundle, n);
}

}  // namespace metaekf::filter
