#include "core/meta/meta_gradient.h"

#include <algorithm>

namespace metaekf::meta {

using nssm::LossData;
using nssm::LossFunction;

namespace {

nn::Mask AllOf(const nssm::Model& model) { return nn::Mask(model.layout().tensors().size(), true); }

}  // namespace

template <typename T>
void RunInnerLoop(const LossFunction<T>& context_loss, const LossData<T>& context, int32_t steps, double learning_rate,
                  int64_t size, T* iterates, T* gradient, const typename LossFunction<T>::Scratch& scratch) {
  for (int32_t m = 0; m < steps; ++m) {
    const T* current = iterates + m * size;
    T* next = iterates + (m + 1) * size;
    context_loss.Gradient(current, context, gradient, scratch);
    for (int64_t i = 0; i < size; ++i) next[i] = current[i] - static_cast<T>(learning_rate) * gradient[i];
  }
}

template <typename T>
MetaGradient<T>::MetaGradient(const nssm::Model& model, const nssm::LossSpec& loss, Algorithm algorithm,
                              const nssm::LossShape& context, const nssm::LossShape& target, const nn::Mask& adapted,
                              int32_t steps, double learning_rate)
    : algorithm_(algorithm),
      steps_(steps),
      learning_rate_(learning_rate),
      size_(model.layout().size()),
      inner_(model, loss, context, adapted, adapted),
      outer_(model, loss, context, AllOf(model), adapted),
      target_(model, loss, target, AllOf(model), adapted) {
  for (size_t i = 0; i < adapted.size(); ++i) {
    const nn::Tensor& tensor = model.layout().tensors()[i];
    if (!adapted[i]) frozen_.push_back({tensor.offset, tensor.size()});
  }
}

template <typename T>
MetaGradient<T>::Scratch::Scratch(const MetaGradient& owner)
    : iterates_(static_cast<size_t>((owner.InnerSteps() + 1) * owner.size_)),
      product_(static_cast<size_t>(owner.size_)),
      masked_(static_cast<size_t>(owner.size_)),
      inner_(owner.inner_.MakeScratch()),
      outer_(owner.outer_.MakeScratch()),
      target_(owner.target_.MakeScratch()) {}

template <typename T>
const T* MetaGradient<T>::Adapt(const T* parameters, const LossData<T>& context, Scratch* scratch) const {
  std::copy_n(parameters, size_, scratch->iterates_.data());
  RunInnerLoop(inner_, context, InnerSteps(), learning_rate_, size_, scratch->iterates_.data(),
               scratch->product_.data(), scratch->inner_);
  return scratch->iterates_.data() + InnerSteps() * size_;
}

template <typename T>
double MetaGradient<T>::TargetLoss(const T* parameters, const LossData<T>& context, const LossData<T>& target,
                                   Scratch* scratch) const {
  return target_.Value(Adapt(parameters, context, scratch), target, scratch->target_);
}

template <typename T>
double MetaGradient<T>::Compute(const T* parameters, const LossData<T>& context, const LossData<T>& target, T* gradient,
                                Scratch* scratch) const {
  const T* adapted = Adapt(parameters, context, scratch);
  const double loss = target_.Gradient(adapted, target, gradient, scratch->target_);
  if (algorithm_ != Algorithm::kMaml) return loss;
  for (int32_t m = steps_; m >= 1; --m) {
    std::copy_n(gradient, size_, scratch->masked_.data());
    for (const auto& [offset, size] : frozen_) std::fill_n(scratch->masked_.data() + offset, size, T(0));
    outer_.HessianVector(scratch->iterates_.data() + (m - 1) * size_, context, scratch->masked_.data(),
                         scratch->product_.data(), scratch->outer_);
    for (int64_t i = 0; i < size_; ++i) gradient[i] -= static_cast<T>(learning_rate_) * scratch->product_[static_cast<size_t>(i)];
  }
  return loss;
}

template void RunInnerLoop(const LossFunction<float>&, const LossData<float>&, int32_t, double, int64_t, float*, float*,
                           const LossFunction<float>::Scratch&);
template void RunInnerLoop(const LossFunction<double>&, const LossData<double>&, int32_t, double, int64_t, double*,
                           double*, const LossFunction<double>::Scratch&);
template class MetaGradient<float>;
template class MetaGradient<double>;

}  // namespace metaekf::meta
