#pragma once

#include <initializer_list>
#include <vector>

#include "absl/status/statusor.h"
#include "core/autodiff/evaluate.h"
#include "core/base/executor.h"
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

/// How a loss function makes products with its Hessian.
enum class HessianProducts {
  kNone,        ///< it makes none
  kFromScratch,
  kFromRecord,  ///< from what the gradient at the same point has recorded: in three quarters of the operations
};

/// L(set; ω), its gradient and its Hessian–vector products, for sets of one shape.
///
///   Case I    L = w_y MSE(y_{t+k}, ŷ_{t+k})_{k=1…H_p} + w_r MSE(y_t, 𝓟𝓓y𝓔)
///   Case II   L = w_r MSE(x_t, 𝓟x𝓓x𝓔(x_t,u_t)) + w_x MSE(x_{t+k}, x̂_{t+k})_{k=1…H_p}
///               + w_y MSE(y_{t+k}, ŷ_{t+k})_{k=0…H_p−1}
///
/// each mean over rollouts, steps and components, in normalised units.
/// Only the parameters of the mask are differentiated; elements of the others are zero in a gradient.
/// Where a large model meets many samples, rollouts are cut into blocks that run side by side on the scratch's executor and are summed
/// in order. Blocks depend on sizes alone, so results do not depend on the number of threads.
/// Compiled once, then safe to call concurrently with a scratch each. No call allocates, but for what it takes to hand blocks to threads.
/// Source: paper.tex eqs. nssm-loss-fn-1, nssm-loss-fn-2; the output path of Case II is the filter's h (eq. h_bar).
template <typename T>
class LossFunction {
 public:
  /// @param differentiated  parameters with a gradient; @param along  parameters in which directions v may be non-zero.
  /// @param products  kFromRecord: gradients are those of the parameters of `along` alone.
  LossFunction(const Model& model, const LossSpec& loss, const LossShape& shape, const nn::Mask& differentiated,
               const nn::Mask& along, HessianProducts products = HessianProducts::kFromScratch);

  /// Memory of one caller, for any of a few functions, one at a time.
  class Scratch {
   public:
    /// @param executor  that blocks run on; it must outlive the scratch.
    explicit Scratch(std::initializer_list<const LossFunction*> users, base::Executor* executor = base::CallingThread());

   private:
    friend class LossFunction;
    base::Executor* executor_;
    std::vector<autodiff::Arena<T>> arenas_;  // of each thread, or of each block where these are fewer
    std::vector<T> losses_;                   // of each block
    // Where there are several blocks, what each reads, and what each but the first writes.
    std::vector<LossData<T>> data_;
    std::vector<std::vector<T>> vectors_;
  };
  Scratch MakeScratch(base::Executor* executor = base::CallingThread()) const { return Scratch({this}, executor); }

  double Value(const T* parameters, const LossData<T>& data, Scratch* scratch) const;
  /// @param gradient  n_ω elements, all written. @param record  record_size() elements, written, or null if that is 0.
  /// @return L.
  double Gradient(const T* parameters, const LossData<T>& data, T* gradient, Scratch* scratch, T* record = nullptr) const;
  /// @param product  n_ω elements, all written: H v. Elements of v outside `along` are ignored.
  /// @param record  of the gradient of these parameters and data, or null if record_size() is 0.
  void HessianVector(const T* parameters, const LossData<T>& data, const T* v, T* product, Scratch* scratch, const T* record = nullptr) const;
  /// Elements of a record; 0 unless products are made from one.
  int64_t record_size() const { return record_size_; }

  const LossShape& shape() const { return shape_; }

 private:
  /// Of a number of rollouts.
  struct Programs {
    autodiff::Executable<T> value, gradient, hessian;
    int64_t record_size;
  };
  /// Rollouts first … first + count − 1, whose part of a record begins at `record`.
  struct Block {
    int32_t first, count;
    size_t programs;
    int64_t record;
  };
  /// Which elements a program writes, and which are zero.
  struct Written {
    nn::Pieces pieces, rest;
  };
  Programs Compile(const Model& model, const LossSpec& loss, int32_t rollouts, const nn::Mask& differentiated, const nn::Mask& along,
                   HessianProducts products) const;
  /// Runs one program of every block. @param v, vector, record  or null. @return the sum of losses.
  double RunBlocks(autodiff::Executable<T> Programs::*program, const T* parameters, const LossData<T>& data, const T* v, T* vector,
                   T* record, Scratch* scratch) const;
  /// Makes of what each block has written one vector.
  void AddBlocks(const Written& written, T* vector, Scratch* scratch) const;

  LossShape shape_;
  int64_t size_;  // of ω
  Written of_gradient_, of_product_;
  int64_t record_size_ = 0;
  std::vector<Block> blocks_;
  std::vector<Programs> programs_;  // of the numbers of rollouts that blocks have
};

}  // namespace metaekf::nssm
