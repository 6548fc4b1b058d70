#include "core/meta/inner_loop.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "core/meta/adam.h"

namespace metaekf::meta {
namespace {

/// m̂ / (√v̂ + ε), the direction of a step of Adam.
double Direction(double m, double v, const AdamCorrections& corrections) {
  return m / corrections.first / (std::sqrt(v / corrections.second) + kAdamEpsilon);
}

/// One element of a step of Adam backwards, with every adjoint negated as PullBack subtracts them.
/// @param to_direction  −d̄. @param m_adjoint, v_adjoint  −m̄ and −v̄ as the later steps have left them. @return −ḡ.
template <typename T>
double PullBackAdam(double to_direction, double g, double m, double v, const AdamCorrections& corrections, T* m_adjoint, T* v_adjoint) {
  const double m_hat = m / corrections.first, root = std::sqrt(v / corrections.second), scale = root + kAdamEpsilon;
  const double to_m = *m_adjoint + to_direction / (corrections.first * scale);
  double to_v = *v_adjoint;
  if (root > 0) to_v -= to_direction * m_hat / (2 * corrections.second * root * scale * scale);
  *m_adjoint = static_cast<T>(kAdamBeta1 * to_m);
  *v_adjoint = static_cast<T>(kAdamBeta2 * to_v);
  return (1 - kAdamBeta1) * to_m + 2 * (1 - kAdamBeta2) * g * to_v;
}

}  // namespace

std::vector<double> RatesOfTensors(const InnerLoopSpec& spec, const nn::ParameterLayout& layout) {
  std::vector<double> rates;
  for (const nn::Tensor& tensor : layout.tensors()) {
    const auto own = spec.tensor_rates.find(tensor.name);
    rates.push_back(own == spec.tensor_rates.end() ? spec.learning_rate : own->second);
  }
  return rates;
}

absl::Status CheckTensorRates(const InnerLoopSpec& spec, const nn::ParameterLayout& layout) {
  for (const auto& [name, rate] : spec.tensor_rates) {
    const auto& tensors = layout.tensors();
    if (std::any_of(tensors.begin(), tensors.end(), [&name = name](const nn::Tensor& tensor) { return tensor.name == name; })) continue;
    return absl::InvalidArgumentError(absl::StrCat("tensor_rates: the model has no tensor \"", name, "\""));
  }
  return absl::OkStatus();
}

template <typename T>
InnerLoop<T>::InnerLoop(const nn::ParameterLayout& layout, const nn::Mask& adapted, Optimiser optimiser, int32_t steps,
                        double pull, InnerRecord record)
    : size_(layout.size()),
      adapted_(nn::PiecesOf(layout, adapted, true)),
      frozen_(nn::PiecesOf(layout, adapted, false)),
      optimiser_(optimiser),
      steps_(steps),
      pull_(pull),
      record_(record) {}

template <typename T>
InnerLoop<T>::Trace::Trace(const InnerLoop& owner, bool rates_are_learned, base::Executor* executor)
    : size_(owner.size_), executor_(executor) {
  const size_t size = static_cast<size_t>(owner.size_), steps = static_cast<size_t>(owner.steps_);
  const bool adam = owner.optimiser_ == Optimiser::kAdam, all = owner.record_ == InnerRecord::kSteps;
  iterates_.resize(all ? (steps + 1) * size : size);
  gradients_.resize(all && (adam || rates_are_learned) ? steps * size : size);
  if (adam) first_.resize(all ? steps * size : size);
  second_.resize(first_.size());
  if (owner.record_ == InnerRecord::kTotal) total_.resize(size);
  if (!all) return;
  direction_.resize(size);
  product_.resize(size);
  if (adam) first_adjoint_.resize(size);
  second_adjoint_.resize(first_adjoint_.size());
}

template <typename T>
T* InnerLoop<T>::Trace::At(std::vector<T>& vectors, int32_t index) const {
  const size_t offset = static_cast<size_t>(index) * static_cast<size_t>(size_);
  return vectors.data() + (offset < vectors.size() ? offset : 0);  // the only one there is
}

template <typename T>
const T* InnerLoop<T>::Run(const T* start, const std::vector<double>& rates, Gradient gradient, Trace* trace) const {
  std::copy_n(start, size_, trace->iterates_.data());
  std::fill(trace->total_.begin(), trace->total_.end(), T(0));
  for (int32_t m = 1; m <= steps_; ++m) {
    const T* current = trace->At(trace->iterates_, m - 1);
    gradient(m, current, trace->At(trace->gradients_, m - 1));
    Step(m, start, rates, current, trace->At(trace->iterates_, m), trace);
  }
  return trace->At(trace->iterates_, steps_);
}

template <typename T>
void InnerLoop<T>::Step(int32_t m, const T* start, const std::vector<double>& rates, const T* from, T* to, Trace* trace) const {
  const T* gradient = trace->At(trace->gradients_, m - 1);
  const auto descend = [&](size_t l, int64_t begin, int64_t end) {
    const T rate = static_cast<T>(rates[l]), shrink = static_cast<T>(1 / (1 + rates[l] * pull_));
    for (int64_t i = begin; i < end; ++i) to[i] = from[i] - rate * gradient[i];
    for (int64_t i = begin; pull_ > 0 && i < end; ++i) to[i] = start[i] + shrink * (to[i] - start[i]);
  };
  T* first = trace->At(trace->first_, m - 1);
  T* second = trace->At(trace->second_, m - 1);
  const T* last_first = m > 1 ? trace->At(trace->first_, m - 2) : nullptr;
  const T* last_second = m > 1 ? trace->At(trace->second_, m - 2) : nullptr;
  const AdamCorrections corrections(m);
  T* total = trace->total_.empty() ? nullptr : trace->total_.data();
  const auto adam = [&](size_t l, int64_t begin, int64_t end) {
    const T rate = static_cast<T>(rates[l]);
    for (int64_t i = begin; i < end; ++i) {
      double m1 = last_first ? last_first[i] : T(0), m2 = last_second ? last_second[i] : T(0);
      const double pulled = gradient[i] + pull_ * (from[i] - start[i]);
      const T direction = static_cast<T>(AdamDirection(pulled, corrections, &m1, &m2));
      first[i] = static_cast<T>(m1);
      second[i] = static_cast<T>(m2);
      if (total) total[i] += direction;
      to[i] = from[i] - rate * direction;
    }
  };
  const auto add_gradient = [&](size_t, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) total[i] += gradient[i];
  };
  if (optimiser_ == Optimiser::kAdam) {
    nn::ForParts(adapted_, trace->executor_, adam);
  } else {
    nn::ForParts(adapted_, trace->executor_, descend);
    if (total) nn::ForParts(adapted_, trace->executor_, add_gradient);
  }
  if (total) nn::ForParts(frozen_, trace->executor_, add_gradient);
  if (from != to) nn::ForParts(frozen_, trace->executor_, [&](size_t, int64_t begin, int64_t end) { std::copy(from + begin, from + end, to + begin); });
}

template <typename T>
void InnerLoop<T>::Subtract(const nn::Pieces& pieces, const T* product, T* adjoint, base::Executor* executor) {
  nn::ForParts(pieces, executor, [&](size_t, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) adjoint[i] -= product[i];
  });
}

template <typename T>
void InnerLoop<T>::AddRateAdjoint(int32_t m, const T* adjoint, Trace* trace, double* rate_adjoint) const {
  const AdamCorrections corrections(m);
  const T* gradient = trace->At(trace->gradients_, m - 1);
  const T* first = trace->At(trace->first_, m - 1);
  const T* second = trace->At(trace->second_, m - 1);
  const bool is_adam = optimiser_ == Optimiser::kAdam;
  for (size_t l = 0; l < adapted_.size(); ++l) {
    double by_rate = 0;
    for (int64_t i = adapted_[l].first; i < adapted_[l].first + adapted_[l].second; ++i) {
      by_rate += static_cast<double>(adjoint[i]) * (is_adam ? Direction(first[i], second[i], corrections) : static_cast<double>(gradient[i]));
    }
    rate_adjoint[l] -= by_rate;
  }
}

template <typename T>
void InnerLoop<T>::StepAdjoint(int32_t m, const std::vector<double>& rates, const T* product, T* adjoint, Trace* trace) const {
  const AdamCorrections corrections(m);
  const T* gradient = trace->At(trace->gradients_, m - 1);
  const T* first = trace->At(trace->first_, m - 1);
  const T* second = trace->At(trace->second_, m - 1);
  const bool is_adam = optimiser_ == Optimiser::kAdam;
  nn::ForParts(adapted_, trace->executor_, [&](size_t l, int64_t begin, int64_t end) {
    T* direction = trace->direction_.data();
    for (int64_t i = begin; product != nullptr && i < end; ++i) adjoint[i] -= product[i];
    for (int64_t i = begin; !is_adam && i < end; ++i) direction[i] = static_cast<T>(rates[l] * static_cast<double>(adjoint[i]));
    for (int64_t i = begin; is_adam && i < end; ++i) {
      direction[i] = static_cast<T>(PullBackAdam(rates[l] * static_cast<double>(adjoint[i]), gradient[i], first[i], second[i], corrections,
                                                 trace->first_adjoint_.data() + i, trace->second_adjoint_.data() + i));
    }
  });
}

template <typename T>
void InnerLoop<T>::PullBack(const std::vector<double>& rates, HessianVector hessian_vector, Trace* trace, T* adjoint,
                            double* rate_adjoint) const {
  for (auto* vector : {&trace->direction_, &trace->first_adjoint_, &trace->second_adjoint_}) {
    std::fill(vector->begin(), vector->end(), T(0));
  }
  const T* const product = trace->product_.data();
  for (int32_t m = steps_; m >= 1; --m) {
    // Of the elements that adapt the later step's product is taken where the direction is made: every pass through ω counts.
    const bool later = m < steps_, pass_of_its_own = later && rate_adjoint != nullptr;
    if (pass_of_its_own) Subtract(adapted_, product, adjoint, trace->executor_);
    if (rate_adjoint != nullptr) AddRateAdjoint(m, adjoint, trace, rate_adjoint);
    StepAdjoint(m, rates, later && !pass_of_its_own ? product : nullptr, adjoint, trace);
    hessian_vector(m, trace->At(trace->iterates_, m - 1), trace->direction_.data(), trace->product_.data());
    Subtract(frozen_, product, adjoint, trace->executor_);
  }
  if (steps_ > 0) Subtract(adapted_, product, adjoint, trace->executor_);
}

template class InnerLoop<float>;
template class InnerLoop<double>;

}  // namespace metaekf::meta
