#pragma once

#include <Eigen/Core>
#include <optional>
#include <vector>

#include "core/nssm/loss.h"
#include "core/nssm/sensitivity.h"

namespace metaekf::nssm {

/// The normal equations of a least-squares problem at one point.
///
///   Φ = ½ Σ_c w_c Σ r_c²,   gradient Jᵀ W r,   curvature Jᵀ W J
///
/// over the unknowns: the adapted parameters in the order of ω, then c₀ where it is unknown too.
struct NormalEquations {
  double cost = 0;                   ///< Φ
  Eigen::VectorXd channel_squares;   ///< Σ r_c² of every channel: states (Case II), then outputs
  Eigen::VectorXd gradient;
  Eigen::MatrixXd curvature;         ///< lower triangle
};

/// The residuals of rollouts over a set, and how they move with the unknowns, exactly.
///
/// Beside the simulation c_{k+1} = f(c_k, u_k; ω), r_k = g(c_k, u_k; ω) − target runs the recursion of its sensitivity,
///
///   S_{k+1} = F_k S_k + ∂f/∂ω,   J_k = C_k S_k + ∂g/∂ω,
///
/// with the local derivatives of many steps computed at once. S₀ is ∂𝓔/∂ω where a rollout starts from the encoder,
/// zero where it starts from a measured state, and the identity in c₀ where the start is unknown.
/// In double and normalised units. Immutable and safe to share; each thread brings a Workspace.
class RolloutLeastSquares {
 public:
  /// @param free_start  c₀ is an unknown and nothing is encoded: one rollout from the first sample on.
  RolloutLeastSquares(const Model& model, const LossSpec& loss, const nn::Mask& mask, bool free_start);

  /// The set as rollouts. With a free start: one, from the first sample over all others.
  /// Errors: FailedPrecondition saying how many samples are needed.
  absl::StatusOr<LossData<double>> Cut(const data::Trajectory& normalised) const;

  /// Programs and memory of one thread, for sets of one shape.
  class Workspace {
   public:
    Workspace(const RolloutLeastSquares& owner, const LossShape& shape);
    Workspace(const Workspace&) = delete;  // terms point into it
    Workspace& operator=(const Workspace&) = delete;

   private:
    friend class RolloutLeastSquares;
    class DirectJacobian;
    struct Compiled {
      explicit Compiled(autodiff::Program program) : executable(std::move(program)), arena({&executable}) {}
      autodiff::Executable<double> executable;
      autodiff::Arena<double> arena;
    };
    int32_t width_;  // rollouts side by side
    int32_t steps_;  // steps at a time
    std::optional<Compiled> encode_, rollout_, local_;
    Eigen::MatrixXd start_, first_input_, inputs_;       // what the programs read: columns step by step
    Eigen::MatrixXd carry_, carries_, next_, channels_;  // what the rollout writes
    Eigen::VectorXd by_carry_;       // [F; C]: of every carry component one block of columns
    Eigen::VectorXd by_parameters_, by_parameters_of_start_;     // what ∂[f; g]/∂ω and ∂𝓔/∂ω are made of
    std::vector<std::vector<DirectTerm>> terms_, start_terms_;  // of every component, pointing there
    Eigen::MatrixXd sensitivity_, next_sensitivity_;  // S of every rollout side by side, unknowns × n each
    Eigen::VectorXd factors_;                         // of one component by the carry
    Eigen::MatrixXd rows_;       // weighted rows of J, as columns; made by the first linearisation, for costs do without
    int64_t kept_rows_;          // of them: all, or as many as are squared at a time
    Eigen::VectorXd residuals_;  // weighted, beside them
    bool holds_all_ = false;
  };

  /// Φ at a point. Infinite if a rollout leaves the numbers.
  /// @param parameters  ω, all of it. @param start  c₀ of a free start, else unused. @param weights  w, one per channel.
  double Cost(const double* parameters, const Eigen::VectorXd& start, const Eigen::VectorXd& weights,
              const LossData<double>& data, Workspace* workspace, Eigen::VectorXd* channel_squares = nullptr) const;
  void Linearise(const double* parameters, const Eigen::VectorXd& start, const Eigen::VectorXd& weights,
                 const LossData<double>& data, Workspace* workspace, NormalEquations* result) const;
  /// Jᵀ W r″ with r″ = d²r(x + s δ)/ds² at s = 0: how the residuals bend along a direction, as the gradient sees it.
  /// By a difference of residuals, at the price of one Cost.
  /// @param parameters, start  at x + h δ. @param workspace  has just linearised at x, on the same data and weights.
  /// @return nothing where the rollouts leave the numbers, or J was too large to be kept.
  std::optional<Eigen::VectorXd> Bend(const double* parameters, const Eigen::VectorXd& start, double h,
                                      const Eigen::VectorXd& direction, const Eigen::VectorXd& weights,
                                      const LossData<double>& data, Workspace* workspace) const;
  /// Predictions of every channel, channels × (steps · rollouts), in the order of the set's columns.
  Eigen::MatrixXd Predictions(const double* parameters, const Eigen::VectorXd& start, const LossData<double>& data,
                              Workspace* workspace) const;
  /// The carries of a free-start rollout, n × (steps + 1): c₀ … c_N.
  Eigen::MatrixXd Carries(const double* parameters, const Eigen::VectorXd& start, const LossData<double>& data,
                          Workspace* workspace) const;

  const nn::Mask& mask() const { return mask_; }
  int32_t carry_size() const { return carry_size_; }
  int32_t adapted_size() const { return adapted_size_; }
  int32_t unknowns() const { return adapted_size_ + (free_start_ ? carry_size_ : 0); }
  int32_t channels() const { return channels_; }
  /// Offsets and sizes in ω of what is adapted, in order.
  const std::vector<std::pair<int64_t, int64_t>>& adapted() const { return adapted_; }

 private:
  /// Calls visit(first step, steps, first rollout, rollouts) after simulating each piece of the set.
  template <typename Visit>
  void ForEachPiece(const double* parameters, const Eigen::VectorXd& start, const LossData<double>& data,
                    Workspace* workspace, const Visit& visit) const;
  void Encode(const double* parameters, const LossData<double>& data, int32_t first, int32_t count,
              Workspace* workspace) const;
  /// Residual r_c of a column of the piece at hand.
  double Residual(const LossData<double>& data, int32_t channel, int64_t column, double prediction) const;

  Model model_;
  LossSpec loss_;
  bool free_start_;
  RolloutMode mode_;
  nn::Mask mask_;
  int32_t carry_size_ = 0, state_channels_ = 0, channels_ = 0, adapted_size_ = 0;
  std::vector<std::pair<int64_t, int64_t>> adapted_;
};

}  // namespace metaekf::nssm
