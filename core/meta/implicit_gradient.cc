#include "core/meta/implicit_gradient.h"

#include <algorithm>
#include <cmath>

namespace metaekf::meta {
namespace {

constexpr double kLeastCurvature = 0.1;

template <typename T>
double Dot(const std::vector<T>& a, const std::vector<T>& b) {
  double sum = 0;
  for (size_t i = 0; i < a.size(); ++i) sum += static_cast<double>(a[i]) * static_cast<double>(b[i]);
  return sum;
}

/// y ← a x + b y.
template <typename T>
void Combine(double a, const std::vector<T>& x, double b, std::vector<T>* y) {
  for (size_t i = 0; i < x.size(); ++i) (*y)[i] = static_cast<T>(a * x[i] + b * (*y)[i]);
}

}  // namespace

template <typename T>
ImplicitGradient<T>::ImplicitGradient(const nn::ParameterLayout& layout, const nn::Mask& adapted, double proximal,
                                      const ImplicitMamlSpec& solver)
    : size_(static_cast<size_t>(layout.size())),
      frozen_(nn::PiecesOf(layout, adapted, false)),
      proximal_(proximal),
      solver_(solver) {}

template <typename T>
ImplicitGradient<T>::Scratch::Scratch(const ImplicitGradient& owner, bool needed) {
  for (auto* vector : {&solution_, &residual_, &direction_, &product_}) vector->resize(needed ? owner.size_ : 0);
}

template <typename T>
void ImplicitGradient<T>::ClearFrozen(std::vector<T>* vector) const {
  for (const auto& [offset, size] : frozen_) std::fill_n(vector->begin() + offset, size, T(0));
}

template <typename T>
void ImplicitGradient<T>::Apply(absl::FunctionRef<void(const T* v, T* product)> hessian_vector, T* gradient,
                                Scratch* scratch) const {
  auto& [solution, residual, direction, product] = *scratch;
  std::copy_n(gradient, size_, residual.begin());
  ClearFrozen(&residual);
  direction = residual;
  std::fill(solution.begin(), solution.end(), T(0));
  double squared = Dot(residual, residual);
  const double enough = squared * solver_.cg_tolerance * solver_.cg_tolerance;
  for (int32_t step = 0; step < solver_.cg_steps && squared > enough; ++step) {
    hessian_vector(direction.data(), product.data());
    ClearFrozen(&product);
    Combine(1, direction, 1 / proximal_, &product);
    const double curvature = Dot(direction, product);
    if (!(curvature > kLeastCurvature * Dot(direction, direction))) {
      if (step == 0) solution = residual;
      break;
    }
    const double length = squared / curvature, before = squared;
    Combine(length, direction, 1, &solution);
    Combine(-length, product, 1, &residual);
    squared = Dot(residual, residual);
    Combine(1, residual, squared / before, &direction);
  }
  if (!frozen_.empty()) hessian_vector(solution.data(), product.data());
  // In the parameters that stay the solution is zero, in the others it replaces t.
  for (const auto& [offset, size] : frozen_) {
    for (int64_t i = offset; i < offset + size; ++i) {
      const size_t k = static_cast<size_t>(i);
      solution[k] = static_cast<T>(gradient[k] - product[k] / proximal_);
    }
  }
  std::copy_n(solution.begin(), size_, gradient);
}

template class ImplicitGradient<float>;
template class ImplicitGradient<double>;

}  // namespace metaekf::meta
