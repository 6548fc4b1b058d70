#include "core/meta/meta_gradient.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include <Eigen/Core>

#include "core/base/rng.h"

namespace metaekf::meta {

using nssm::LossData;
using nssm::LossShape;

namespace {

constexpr int kSettlingSteps = 10;  // of Newton, at most
constexpr int kPowerSteps = 30;
constexpr double kPowerTolerance = 0.01;  // relative
constexpr int64_t kMostRecorded = 2;  // of a step, in parameter vectors
constexpr double kSettled = 0.25;   // of the last squared slope: one that falls no further is down to rounding

nn::Mask AllOf(const nssm::Model& model) { return nn::Mask(model.layout().tensors().size(), true); }

InnerRecord RecordFor(const TrainingSpec& spec) {
  if (spec.algorithm == Algorithm::kMaml) return InnerRecord::kSteps;
  const bool needs_total = spec.algorithm == Algorithm::kReptile || spec.inner_loop.learned_rates;
  return needs_total ? InnerRecord::kTotal : InnerRecord::kResult;
}

template <typename T>
InnerLoop<T> MakeLoop(const nssm::Model& model, const TrainingSpec& spec, const nn::Mask& adapted) {
  const bool one_loop = spec.algorithm == Algorithm::kSupervised || spec.algorithm == Algorithm::kMixedEffects;
  const int32_t steps = one_loop ? 0 : spec.inner_loop.steps;
  const double pull = spec.algorithm == Algorithm::kImplicitMaml ? spec.inner_loop.proximal : 0;
  return InnerLoop<T>(model.layout(), adapted, spec.inner_loop.optimiser, steps, pull, RecordFor(spec));
}

/// The loss on the context set whose Hessian the meta-gradient needs. MAML's products are at the points of the gradients before them, which
/// record their activations unless these are far larger than ω: they are kept for every step.
template <typename T>
nssm::LossFunction<T> OuterLoss(const nssm::Model& model, const TrainingSpec& spec, const LossShape& context, const nn::Mask& adapted) {
  if (spec.algorithm == Algorithm::kMaml) {
    nssm::LossFunction<T> recording(model, spec.loss, context, AllOf(model), adapted, nssm::HessianProducts::kFromRecord);
    if (recording.record_size() <= kMostRecorded * model.layout().size()) return recording;
  }
  return nssm::LossFunction<T>(model, spec.loss, context, AllOf(model), adapted);
}

bool GoesToMinimum(const TrainingSpec& spec) {
  return spec.algorithm == Algorithm::kImplicitMaml && spec.inner_loop.optimiser == Optimiser::kLevenbergMarquardt;
}

template <typename T>
LossData<double> InDouble(const LossData<T>& data) {
  const auto copy = [](const std::vector<T>& values) { return std::vector<double>(values.begin(), values.end()); };
  return {.shape = data.shape,
          .start = copy(data.start),
          .first_input = copy(data.first_input),
          .inputs = copy(data.inputs),
          .states = copy(data.states),
          .outputs = copy(data.outputs),
          .first_output = copy(data.first_output)};
}

std::vector<double> RatesOfAdapted(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& adapted) {
  const std::vector<double> of_tensors = RatesOfTensors(spec.inner_loop, model.layout());
  std::vector<double> rates;
  for (size_t i = 0; i < adapted.size(); ++i) {
    if (adapted[i]) rates.push_back(of_tensors[i]);
  }
  return rates;
}

}  // namespace

template <typename T>
MetaGradient<T>::MetaGradient(const nssm::Model& model, const TrainingSpec& spec, const LossShape& context,
                              const LossShape& target, const nn::Mask& adapted)
    : algorithm_(spec.algorithm),
      learned_rates_(spec.inner_loop.learned_rates),
      size_(model.layout().size()),
      rates_(RatesOfAdapted(spec, model, adapted)),
      loop_(MakeLoop<T>(model, spec, adapted)),
      implicit_(model.layout(), adapted, spec.inner_loop.proximal, spec.implicit_maml),
      loss_(spec.loss),
      steps_(spec.inner_loop.steps),
      proximal_(spec.inner_loop.proximal),
      tolerance_(spec.implicit_maml.cg_tolerance),
      inner_(model, spec.loss, context, adapted, adapted),
      outer_(OuterLoss<T>(model, spec, context, adapted)),
      target_(model, spec.loss, target, AllOf(model), adapted, nssm::HessianProducts::kNone) {
  if (GoesToMinimum(spec)) least_squares_.emplace(model, spec.loss, adapted, false);
}

template <typename T>
MetaGradient<T>::Scratch::Scratch(const MetaGradient& owner, base::Executor* executor)
    : trace_(owner.loop_, owner.learned_rates_, executor),
      implicit_(owner.implicit_, owner.algorithm_ == Algorithm::kImplicitMaml),
      target_gradient_(owner.algorithm_ == Algorithm::kReptile ? static_cast<size_t>(owner.size_) : 0),
      rates_(owner.rates_),
      rate_adjoints_(owner.rates_.size()),
      records_(static_cast<size_t>(owner.steps_ * owner.outer_.record_size())),
      loss_({&owner.inner_, &owner.outer_, &owner.target_}, executor) {
  if (!owner.least_squares_) return;
  least_squares_ = std::make_unique<nssm::RolloutLeastSquares::Workspace>(*owner.least_squares_, owner.inner_.shape());
  for (auto* vector : {&minimum_, &last_, &step_}) vector->resize(static_cast<size_t>(owner.size_));
}

template <typename T>
size_t MetaGradient<T>::variables() const {
  return static_cast<size_t>(size_) + (learned_rates_ ? rates_.size() : 0);
}

template <typename T>
void MetaGradient<T>::ReadRates(const T* variables, Scratch* scratch) const {
  if (!learned_rates_) return;
  const T* logarithms = variables + size_;
  for (size_t l = 0; l < rates_.size(); ++l) scratch->rates_[l] = std::exp(static_cast<double>(logarithms[l]));
}

template <typename T>
const T* MetaGradient<T>::Adapt(const T* variables, const LossData<T>& context, Scratch* scratch) const {
  if (least_squares_) return Minimum(variables, context, scratch);
  ReadRates(variables, scratch);
  const nssm::LossFunction<T>& loss = records() ? outer_ : inner_;
  const auto gradient = [&](int32_t m, const T* at, T* result) { loss.Gradient(at, context, result, &scratch->loss_, RecordOf(m, scratch)); };
  return loop_.Run(variables, scratch->rates_, gradient, &scratch->trace_);
}

template <typename T>
T* MetaGradient<T>::RecordOf(int32_t m, Scratch* scratch) const {
  return records() ? scratch->records_.data() + (m - 1) * outer_.record_size() : nullptr;
}

template <typename T>
const T* MetaGradient<T>::Minimum(const T* start, const LossData<T>& context, Scratch* scratch) const {
  std::vector<double> parameters(start, start + size_);
  const MapFit fit = FitProximal(*least_squares_, loss_, InDouble(context), parameters,
                                 {.proximal = proximal_, .steps = steps_}, scratch->least_squares_.get());
  ScatterAdapted(*least_squares_, fit.unknowns, &parameters);
  scratch->minimum_.assign(parameters.begin(), parameters.end());
  if (fit.converged) Settle(start, context, scratch);
  return scratch->minimum_.data();
}

template <typename T>
void MetaGradient<T>::Settle(const T* start, const LossData<T>& context, Scratch* scratch) const {
  std::vector<T>&at = scratch->minimum_, &step = scratch->step_, &last = scratch->last_;
  const auto hessian_vector = [&](const T* v, T* product) {
    inner_.HessianVector(at.data(), context, v, product, &scratch->loss_);
  };
  double last_slope = std::numeric_limits<double>::infinity();
  for (int i = 0; i <= kSettlingSteps; ++i) {
    inner_.Gradient(at.data(), context, step.data(), &scratch->loss_);
    double slope = 0, pull = 0;
    for (size_t k = 0; k < at.size(); ++k) {
      const double pulled = proximal_ * (static_cast<double>(at[k]) - static_cast<double>(start[k]));
      step[k] = static_cast<T>(step[k] + pulled);
      slope += static_cast<double>(step[k]) * static_cast<double>(step[k]);
      pull += pulled * pulled;
    }
    if (i > 0 && !(slope < last_slope)) at = last;
    if (!(slope < kSettled * last_slope) || slope <= tolerance_ * tolerance_ * pull || i == kSettlingSteps) break;
    last_slope = slope;
    last = at;
    implicit_.Apply(hessian_vector, step.data(), &scratch->implicit_);
    for (size_t k = 0; k < at.size(); ++k) at[k] = static_cast<T>(at[k] - step[k] / proximal_);
  }
}

template <typename T>
double MetaGradient<T>::TargetLoss(const T* variables, const LossData<T>& context, const LossData<T>& target,
                                   Scratch* scratch) const {
  return target_.Value(Adapt(variables, context, scratch), target, &scratch->loss_);
}

template <typename T>
std::vector<double> MetaGradient<T>::Curvatures(const T* variables, const LossData<T>& context, Scratch* scratch) const {
  using Vector = Eigen::Matrix<T, Eigen::Dynamic, 1>;
  std::vector<double> curvatures;
  Vector v(size_), product(size_);
  base::Rng rng(0);
  for (const auto& [offset, size] : loop_.adapted()) {
    v.setZero();
    for (int64_t i = offset; i < offset + size; ++i) v[i] = static_cast<T>(rng.Normal());
    double curvature = 0;
    for (int step = 0; step < kPowerSteps; ++step) {
      const T length = v.norm();
      if (!(length > 0)) break;  // no curvature, or none that is a number
      v /= length;
      inner_.HessianVector(variables, context, v.data(), product.data(), &scratch->loss_);
      v.segment(offset, size) = product.segment(offset, size);
      const double last = curvature;
      curvature = static_cast<double>(v.norm());
      if (std::fabs(curvature - last) <= kPowerTolerance * curvature) break;
    }
    curvatures.push_back(curvature);
  }
  return curvatures;
}

template <typename T>
double MetaGradient<T>::Compute(const T* variables, const LossData<T>& context, const LossData<T>& target, T* gradient,
                                Scratch* scratch) const {
  if (algorithm_ == Algorithm::kReptile) return Reptile(variables, context, target, gradient, scratch);
  const T* adapted = Adapt(variables, context, scratch);
  const double loss = target_.Gradient(adapted, target, gradient, &scratch->loss_);
  std::fill(scratch->rate_adjoints_.begin(), scratch->rate_adjoints_.end(), 0.0);
  if (algorithm_ == Algorithm::kMaml) PullBack(context, gradient, scratch);
  if (algorithm_ == Algorithm::kImplicitMaml) {
    const auto hessian_vector = [&](const T* v, T* product) {
      outer_.HessianVector(adapted, context, v, product, &scratch->loss_);
    };
    implicit_.Apply(hessian_vector, gradient, &scratch->implicit_);
  }
  if (learned_rates_) WriteRateGradient(gradient, scratch);
  return loss;
}

template <typename T>
void MetaGradient<T>::PullBack(const LossData<T>& context, T* gradient, Scratch* scratch) const {
  const auto hessian_vector = [&](int32_t m, const T* at, const T* v, T* product) {
    outer_.HessianVector(at, context, v, product, &scratch->loss_, RecordOf(m, scratch));
  };
  loop_.PullBack(scratch->rates_, hessian_vector, &scratch->trace_, gradient,
                 learned_rates_ ? scratch->rate_adjoints_.data() : nullptr);
}

template <typename T>
void MetaGradient<T>::WriteRateGradient(T* gradient, Scratch* scratch) const {
  for (size_t l = 0; l < rates_.size(); ++l) {
    double adjoint = scratch->rate_adjoints_[l];
    if (algorithm_ == Algorithm::kFirstOrderMaml) {
      const auto [offset, size] = loop_.adapted()[l];
      for (int64_t i = offset; i < offset + size; ++i) {
        adjoint -= static_cast<double>(gradient[i]) * static_cast<double>(scratch->trace_.total()[i]);
      }
    }
    gradient[static_cast<size_t>(size_) + l] = static_cast<T>(scratch->rates_[l] * adjoint);
  }
}

template <typename T>
double MetaGradient<T>::Reptile(const T* variables, const LossData<T>& context, const LossData<T>& target, T* gradient,
                                Scratch* scratch) const {
  const auto samples = [](const LossShape& shape) { return static_cast<double>(shape.rollouts) * shape.horizon; };
  const double share = samples(context.shape) / (samples(context.shape) + samples(target.shape));
  T* of_target = scratch->target_gradient_.data();
  const auto union_gradient = [&](int32_t, const T* at, T* result) {
    outer_.Gradient(at, context, result, &scratch->loss_);
    target_.Gradient(at, target, of_target, &scratch->loss_);
    for (int64_t i = 0; i < size_; ++i) result[i] = static_cast<T>(share * result[i] + (1 - share) * of_target[i]);
  };
  const T* adapted = loop_.Run(variables, scratch->rates_, union_gradient, &scratch->trace_);
  std::copy_n(scratch->trace_.total(), size_, gradient);
  return share * outer_.Value(adapted, context, &scratch->loss_) +
         (1 - share) * target_.Value(adapted, target, &scratch->loss_);
}

template class MetaGradient<float>;
template class MetaGradient<double>;

}  // namespace metaekf::meta
