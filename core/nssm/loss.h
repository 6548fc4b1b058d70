#pragma once

#include <optional>
#include <vector>

#include "absl/status/statusor.h"
#include "core/autodiff/evaluate.h"
#include "core/data/trajectory.h"
#include "core/nssm/model.h"

namespace metaekf::nssm {

/// How many rollouts of how many steps a loss over a set has.
struct LossShape {
  int32_t rollouts = 0;  // W
  int32_t horizon = 0;   // H_p

  bool operator==(const LossShape&) const = default;
};

/// The shape of a loss over `samples` consecutive samples.
/// Errors: FailedPrecondition saying how many samples are needed.
absl::StatusOr<LossShape> ShapeOfLoss(const ModelSpec& model, const LossSpec& loss, int64_t samples);

/// Samples needed for one rollout.
int64_t SamplesNeeded(const ModelSpec& model, const LossSpec& loss);

/// A context or target set, cut into the matrices that a loss reads. Columns: rollouts; step by step where
/// there are steps.
template <typename T>
struct LossData {
  LossShape shape;
  std::vector<T> start;        // start_size × W
  std::vector<T> first_input;  // n_u × W
  std::vector<T> inputs;       // n_u × H_p·W
  std::vector<T> states;       // n_x × H_p·W: x_{k+1}
  std::vector<T> outputs;      // n_y × H_p·W: Case I y_{k+1}, Case II y_k
  std::vector<T> first_output; // n_y × W: Case I y_0, for the reconstruction
};

/// Cuts the rollouts of `shape` from a trajectory in normalised units, from sample `first` on.
template <typename T>
LossData<T> CutLossData(const ModelSpec& model, const LossSpec& loss, const data::Trajectory& normalised, int64_t first,
                        const LossShape& shape);

/// L(set; ω), its gradient and its Hessian–vector products, for sets of one shape.
///
///   Case I    L = w_y MSE(y_{t+k}, ŷ_{t+k})_{k=1…H_p} + w_r MSE(y_t, 𝓟𝓓y𝓔)
///   Case II   L = w_r MSE(x_t, 𝓟x𝓓x𝓔(x_t,u_t)) + w_x MSE(x_{t+k}, x̂_{t+k})_{k=1…H_p}
///               + w_y MSE(y_{t+k}, ŷ_{t+k})_{k=0…H_p−1}
///
/// each mean over rollouts, steps and components, in normalised units.
/// Only the parameters of the mask are differentiated; elements of the others are zero in a gradient.
/// Compiled once, then safe to call concurrently with a workspace each. No call allocates.
/// Source: paper.tex eqs. nssm-loss-fn-1, nssm-loss-fn-2; the output path of Case II is the filter's h (eq. h_bar).
template <typename T>
class LossFunction {
 public:
  /// @param differentiated  parameters with a gradient; @param along  parameters in which directions v may be non-zero.
  LossFunction(const Model& model, const LossSpec& loss, const LossShape& shape, const nn::Mask& differentiated,
               const nn::Mask& along);

  /// Scratch for one thread.
  using Scratch = autodiff::Arena<T>;
  Scratch MakeScratch() const { return Scratch({&*value_, &*gradient_, &*hessian_}); }

  double Value(const T* parameters, const LossData<T>& data, const Scratch& scratch) const;
  /// @param gradient  n_ω elements, all written. @return L.
  double Gradient(const T* parameters, const LossData<T>& data, T* gradient, const Scratch& scratch) const;
  /// @param product  n_ω elements, all written: H v. Elements of v outside `along` are ignored.
  void HessianVector(const T* parameters, const LossData<T>& data, const T* v, T* product, const Scratch& scratch) const;

  const LossShape& shape() const { return shape_; }

 private:
  static autodiff::Slots<T> Bind(const T* parameters, const LossData<T>& data);
  void ClearUndifferentiated(T* vector) const;

  LossShape shape_;
  std::vector<std::pair<int64_t, int64_t>> undifferentiated_;  // offset and size of each
  std::optional<autodiff::Executable<T>> value_, gradient_, hessian_;  // set by the constructor, always
};

}  // namespace metaekf::nssm
