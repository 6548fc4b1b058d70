#include "core/filter/filter_model.h"

#include <algorithm>
#include <array>
#include <type_traits>

#include "absl/container/inlined_vector.h"
#include "core/autodiff/differentiate.h"
#include "core/autodiff/evaluate.h"
#include "core/autodiff/keep.h"
#include "core/autodiff/packed_weights.h"
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

constexpr size_t kMostTogether = 8;  // points: with more, columns are no longer few
constexpr int64_t kLarge = 1 << 15;  // parameters, which no longer stay in the first cache

enum Slot : int32_t { kParameters, kState, kInput, kDirection, kPrepared, kValueOut, kJacobianOut };

enum Function : size_t { kTransition, kMeasurement, kReconstruction, kFunctions };

/// Of each function of state and input its value with the Jacobian by the state, and its derivative along one direction of the parameters.
struct Programs {
  /// What follows from the parameters alone, for `with_jacobian` to read.
  std::array<autodiff::Program, kFunctions> prepare;
  std::array<int64_t, kFunctions> prepared_size{};
  std::array<autodiff::Program, kFunctions> with_jacobian, along;
  autodiff::Program encode;
};

/// value(x, u) and its derivative along every component of x at once.
std::vector<autodiff::Output> WithJacobian(Graph* graph, Value value, Value state) {
  const int32_t n = graph->node(state).rows;
  std::vector<double> identity(static_cast<size_t>(n) * static_cast<size_t>(n), 0);
  for (int32_t i = 0; i < n; ++i) identity[static_cast<size_t>(i) * static_cast<size_t>(n + 1)] = 1;
  Value jacobian = autodiff::Jvp(graph, {{state, graph->ConstantData(std::move(identity), n, n)}}, {value}, n)[0];
  if (jacobian == kNoValue) jacobian = graph->Constant(0, graph->node(value).rows, n);
  return {{value, kValueOut}, {jacobian, kJacobianOut}};
}

Programs BuildPrograms(const nssm::Model& model, int32_t n) {
  const nssm::ModelSpec& spec = model.spec();
  Programs programs;
  const auto build = [&](Function which, const auto& function) {
    for (const bool by_parameters : {false, true}) {
      Graph graph;
      const nn::ParameterValues parameters = nn::BindParameters(model.layout(), kParameters, &graph);
      const nssm::ModelGraph parts(&model, &graph, parameters);
      const Value state = graph.Input(kState, 0, n, 1);
      const Value value = function(parts, state, spec.input_size > 0 ? graph.Input(kInput, 0, spec.input_size, 1) : kNoValue);
      if (!by_parameters) {
        const std::vector<autodiff::Output> outputs = WithJacobian(&graph, value, state);
        const std::vector<autodiff::Output> prepared = autodiff::ValuesFromSlot(graph, outputs, kParameters, kPrepared);
        programs.prepare[which] = autodiff::Compile(graph, prepared);
        programs.prepared_size[which] = autodiff::SizeOfKept(graph, prepared);
        for (const autodiff::Output& output : prepared) graph.TurnIntoInput(output.value, output.slot, output.offset);
        programs.with_jacobian[which] = autodiff::Compile(graph, outputs);
        continue;
      }
      const nn::ParameterValues direction = nn::BindParameters(model.layout(), kDirection, &graph);
      std::vector<autodiff::Seed> seeds;
      for (size_t i = 0; i < parameters.size(); ++i) seeds.push_back({parameters[i], direction[i]});
      Value tangent = autodiff::Jvp(&graph, seeds, {value})[0];
      if (tangent == kNoValue) tangent = graph.Constant(0, graph.node(value).rows, 1);
      programs.along[which] = autodiff::Compile(graph, {{tangent, kValueOut}});
    }
  };
  using Parts = nssm::ModelGraph;
  build(kTransition, [&](const Parts& parts, Value state, Value input) {
    return spec.is_case_one() ? parts.Advance(state, input) : parts.State(parts.Advance(parts.Encode(state, input), input));
  });
  build(kMeasurement, [&](const Parts& parts, Value state, Value input) {
    return spec.is_case_one() ? parts.Output(state, kNoValue) : parts.Output(parts.Encode(state, input), state);
  });
  if (!spec.is_case_one()) {
    build(kReconstruction, [&](const Parts& parts, Value state, Value input) { return parts.State(parts.Encode(state, input)); });
  }
  if (spec.is_case_one() && !spec.fits_start()) {
    Graph graph;
    const nssm::ModelGraph parts(&model, &graph, nn::BindParameters(model.layout(), kParameters, &graph));
    const Value window = graph.Input(kState, 0, model.start_size(), 1);
    programs.encode = autodiff::Compile(graph, {{parts.Encode(window, kNoValue), kValueOut}});
  }
  return programs;
}

FilterModel::Point PointOf(const FilterModel::Parameters& parameters, const Eigen::Ref<const VectorXd>& x, const Eigen::Ref<const VectorXd>& u,
                           VectorXd* value, MatrixXd* jacobian) {
  return {&parameters, {x.data(), x.size()}, {u.data(), u.size()}, value, jacobian};
}

template <typename T>
class TypedFilterModel : public FilterModel {
 public:
  TypedFilterModel(Programs programs, const nssm::Bundle& bundle, int32_t state_size)
      : model_(bundle.model),
        prepare_{Executable<T>(std::move(programs.prepare[kTransition])), Executable<T>(std::move(programs.prepare[kMeasurement])),
                 Executable<T>(std::move(programs.prepare[kReconstruction]))},
        prepared_size_(programs.prepared_size),
        with_jacobian_{Executable<T>(std::move(programs.with_jacobian[kTransition])), Executable<T>(std::move(programs.with_jacobian[kMeasurement])),
                       Executable<T>(std::move(programs.with_jacobian[kReconstruction]))},
        along_{Executable<T>(std::move(programs.along[kTransition])), Executable<T>(std::move(programs.along[kMeasurement])),
               Executable<T>(std::move(programs.along[kReconstruction]))},
        encode_(std::move(programs.encode)),
        argument_size_(std::max<int64_t>(state_size, model_.start_size())),
        input_size_(model_.spec().input_size),
        value_size_(std::max(state_size, model_.spec().output_size)) {
    state_size_ = state_size;
    if (model_.spec().fits_start()) prior_ = bundle.prior;
  }

  std::unique_ptr<Parameters> Prepare(const std::vector<double>& parameters, const MatrixXd& directions, const Parameters* base) const override {
    auto typed = std::make_unique<TypedParameters>(directions);
    typed->values.assign(parameters.begin(), parameters.end());
    if (prior_) typed->exact = parameters;
    const auto* const other = static_cast<const TypedParameters*>(base);
    typed->packed.emplace(std::initializer_list<const Executable<T>*>{&with_jacobian_[kTransition], &with_jacobian_[kMeasurement], &with_jacobian_[kReconstruction]},
                          kParameters, typed->values.data(), other == nullptr ? nullptr : &*other->packed);
    std::vector<bool> unknown(typed->values.size(), false);
    for (Eigen::Index i = 0; i < directions.rows(); ++i) unknown[static_cast<size_t>(i)] = directions.cols() > 0 && (directions.row(i).array() != 0).any();
    const Arena<T> arena(Executables());
    for (size_t function = 0; function < kFunctions; ++function) {
      typed->known[function] = typed->packed->Without(function, unknown);
      typed->prepared[function].resize(prepared_size_[function]);
      PrepareValues(function, typed->values.data(), typed->prepared[function].data(), arena);
    }
    return typed;
  }

  std::unique_ptr<Scratch> MakeScratch() const override { return std::make_unique<TypedScratch>(*this); }
  bool is_large() const override { return model_.layout().size() >= kLarge; }

  using FilterModel::Measurement;
  using FilterModel::Transition;
  void Transition(std::span<const Point> points, Scratch* scratch) const override { Run(kTransition, state_size_, points, scratch); }
  void Measurement(std::span<const Point> points, Scratch* scratch) const override {
    Run(kMeasurement, model_.spec().output_size, points, scratch);
  }
  void Reconstruct(const Parameters& parameters, const Eigen::Ref<const VectorXd>& x, const Eigen::Ref<const VectorXd>& u,
                   VectorXd* reconstruction, MatrixXd* J, Scratch* scratch) const override {
    const Point point = PointOf(parameters, x, u, reconstruction, J);
    Run(kReconstruction, state_size_, {&point, 1}, scratch);
  }

  void Encode(const Parameters& parameters, const Eigen::Ref<const VectorXd>& window, VectorXd* latent, Scratch* scratch) const override {
    TypedScratch& s = static_cast<TypedScratch&>(*scratch);
    const TypedParameters& typed = static_cast<const TypedParameters&>(parameters);
    if (prior_) {
      s.window = window;
      *latent = s.start_fit->Fit(typed.exact.data(), s.window).col(0);
      return;
    }
    Lane& lane = s.lanes.front();
    lane.argument.head(window.size()) = window.template cast<T>();
    Slots<T> slots;
    slots.Input(kParameters, typed.values.data()).Input(kState, lane.argument.data()).Output(kValueOut, lane.value.data());
    autodiff::Evaluate(encode_, slots, s.arena);
    *latent = lane.value.head(latent->size()).template cast<double>();
  }

  MatrixXd EncodedCovariance(const Scratch& scratch) const override {
    return static_cast<const TypedScratch&>(scratch).start_fit->Covariance();
  }

 private:
  using Vector = Eigen::Matrix<T, Eigen::Dynamic, 1>;
  using Matrix = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic>;
  using Factors = autodiff::Packed<T>;

  struct TypedParameters : Parameters {
    explicit TypedParameters(const MatrixXd& unknown) : along(unknown.template cast<T>()) { directions_ = unknown.cols(); }
    std::vector<T> values;
    Matrix along;  // V
    std::optional<autodiff::PackedWeights<T>> packed;
    std::array<Factors, kFunctions> known;  // of weights that V leaves alone
    std::array<Vector, kFunctions> prepared;  // what follows from `values` alone
    std::vector<double> exact;  // for StartFit
  };
  /// What a point is evaluated with.
  struct Lane {
    explicit Lane(const TypedFilterModel& owner) : argument(owner.argument_size_), input(owner.input_size_), value(owner.value_size_),
                                                   jacobian(int64_t{owner.value_size_} * owner.state_size_),
                                                   prepared(*std::max_element(owner.prepared_size_.begin(), owner.prepared_size_.end())) {}
    Vector parameters;  // ω̂ + V z
    Vector argument, input, value, jacobian;
    Vector prepared;  // of `parameters`
  };
  struct TypedScratch : Scratch {
    explicit TypedScratch(const TypedFilterModel& owner) : arena(owner.Executables(), owner.lanes()), lanes(owner.lanes(), Lane(owner)) {
      lanes.front().parameters.resize(owner.model_.layout().size());
      if (!owner.prior_) return;
      start_fit.emplace(owner.model_, *owner.prior_, 1);
      window.resize(owner.model_.start_size(), 1);
    }
    Arena<T> arena;
    std::vector<Lane> lanes;
    std::optional<nssm::StartFit> start_fit;
    MatrixXd window;
  };

  size_t lanes() const { return is_large() ? kMostTogether : 1; }

  std::vector<const Executable<T>*> Executables() const {
    std::vector<const Executable<T>*> all{&encode_};
    for (const Executable<T>& executable : with_jacobian_) all.push_back(&executable);
    for (const Executable<T>& executable : along_) all.push_back(&executable);
    for (const Executable<T>& executable : prepare_) all.push_back(&executable);
    return all;
  }

  void PrepareValues(size_t function, const T* parameters, T* prepared, const Arena<T>& arena) const {
    Slots<T> slots;
    slots.Input(kParameters, parameters).Output(kPrepared, prepared);
    autodiff::Evaluate(prepare_[function], slots, arena);
  }

  /// @param rows  of the function's value.
  void Run(Function function, Eigen::Index rows, std::span<const Point> points, Scratch* scratch) const {
    TypedScratch& s = static_cast<TypedScratch&>(*scratch);
    while (!points.empty()) {
      const std::span<const Point> together = points.first(std::min(points.size(), s.lanes.size()));
      absl::InlinedVector<autodiff::Run<T>, kMostTogether> runs;
      for (size_t i = 0; i < together.size(); ++i) runs.push_back(Begin(function, rows, together[i], &s.lanes[i], s.arena));
      autodiff::EvaluateTogether(with_jacobian_[function], std::span<const autodiff::Run<T>>(runs), s.arena);
      for (size_t i = 0; i < together.size(); ++i) Finish(function, rows, together[i], &runs[i].slots, &s.lanes[i], s.arena);
      points = points.subspan(together.size());
    }
  }

  // Programs read and write the caller's own memory where its numbers are of their kind, else the lane's.
  static constexpr bool kSame = std::is_same_v<T, double>;
  static const T* In(const double* from, Eigen::Index size, Vector* copy) {
    if constexpr (kSame) return from;
    copy->head(size) = Eigen::Map<const VectorXd>(from, size).template cast<T>();
    return copy->data();
  }
  static T* Out(double* to, Vector* instead) {
    if constexpr (kSame) return to;
    return instead->data();
  }
  static void BringBack(const T* made, Eigen::Index size, double* to) {
    if constexpr (!kSame) std::copy_n(made, size, to);
  }
  static bool IsWhole(const MatrixXd& jacobian, Eigen::Index rows) { return kSame && jacobian.rows() == rows; }

  autodiff::Run<T> Begin(Function function, Eigen::Index rows, const Point& point, Lane* lane, const Arena<T>& arena) const {
    const TypedParameters& typed = static_cast<const TypedParameters&>(*point.parameters);
    const Eigen::Index n = state_size_, r = point.x.size() - n;
    const T* omega = typed.values.data();
    const T* prepared = typed.prepared[function].data();
    if (r > 0) {
      lane->parameters = Eigen::Map<const Vector>(omega, model_.layout().size());
      for (Eigen::Index k = 0; k < r; ++k) lane->parameters += static_cast<T>(point.x[n + k]) * typed.along.col(k);
      omega = lane->parameters.data();
      PrepareValues(function, omega, lane->prepared.data(), arena);
      prepared = lane->prepared.data();
    }
    autodiff::Run<T> run{.packed = r > 0 ? &typed.known[function] : &typed.packed->Of(function)};
    run.slots.Input(kParameters, omega)
        .Input(kState, In(point.x.data(), n, &lane->argument))
        .Input(kInput, In(point.u.data(), point.u.size(), &lane->input))
        .Input(kPrepared, prepared)
        .Output(kValueOut, Out(point.value->data(), &lane->value))
        .Output(kJacobianOut, IsWhole(*point.jacobian, rows) ? Out(point.jacobian->data(), &lane->jacobian) : lane->jacobian.data());
    return run;
  }

  void Finish(Function function, Eigen::Index rows, const Point& point, Slots<T>* slots, Lane* lane, const Arena<T>& arena) const {
    const TypedParameters& typed = static_cast<const TypedParameters&>(*point.parameters);
    const Eigen::Index n = state_size_, r = point.x.size() - n;
    BringBack(lane->value.data(), rows, point.value->data());
    if (!IsWhole(*point.jacobian, rows)) point.jacobian->block(0, 0, rows, n) = Eigen::Map<const Matrix>(lane->jacobian.data(), rows, n).template cast<double>();
    for (Eigen::Index k = 0; k < r; ++k) {
      double* const column = point.jacobian->col(n + k).data();
      slots->Input(kDirection, typed.along.col(k).data()).Output(kValueOut, Out(column, &lane->value));
      autodiff::Evaluate(along_[function], *slots, arena);
      BringBack(lane->value.data(), rows, column);
    }
  }

  const nssm::Model model_;
  std::optional<nssm::GaussianPrior> prior_;
  std::array<Executable<T>, kFunctions> prepare_;
  std::array<int64_t, kFunctions> prepared_size_;
  std::array<Executable<T>, kFunctions> with_jacobian_, along_;
  Executable<T> encode_;
  int64_t argument_size_;
  int32_t input_size_, value_size_;
};

}  // namespace

std::unique_ptr<FilterModel::Parameters> FilterModel::Prepare(const nssm::Bundle& bundle, const Parameters* base) const {
  return Prepare(bundle.parameters, UnknownDirections(bundle), base);
}

void FilterModel::Transition(const Parameters& parameters, const Eigen::Ref<const VectorXd>& x, const Eigen::Ref<const VectorXd>& u, VectorXd* f,
                             MatrixXd* F, Scratch* scratch) const {
  const Point point = PointOf(parameters, x, u, f, F);
  Transition({&point, 1}, scratch);
}

void FilterModel::Measurement(const Parameters& parameters, const Eigen::Ref<const VectorXd>& x, const Eigen::Ref<const VectorXd>& u, VectorXd* h,
                              MatrixXd* H, Scratch* scratch) const {
  const Point point = PointOf(parameters, x, u, h, H);
  Measurement({&point, 1}, scratch);
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
