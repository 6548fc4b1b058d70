#pragma once

#include <Eigen/Core>
#include <optional>
#include <vector>

#include "core/autodiff/evaluate.h"
#include "core/nssm/model.h"
#include "core/nssm/prior.h"

namespace metaekf::nssm {

/// 𝓔 of a Case I model with StartMode::kFitted: ψ_t is where the most probable trajectory through the window ends.
///
///   ψ_s = argmin ½ Σ_{k=s+1…t} |y_k − ŷ_k(ψ_s)|²/σ² + ½ ψ_sᵀ Λ ψ_s,   s = t − H + 1
///
/// by Levenberg–Marquardt with exact Jacobians, several windows side by side. Each begins at the prior's guess or at 0, whichever
/// explains its window better: the guess is of the fleet's models, and one that was fitted from scratch has other latents.
/// In double, normalised units. One thread at a time.
class StartFit {
 public:
  /// @param prior  its `start` is Λ, its `noise_variance` σ², its `start_guess` the guess. @param width  windows side by side.
  StartFit(const Model& model, const GaussianPrior& prior, int32_t width);

  /// @param windows  start_size() × any number, samples oldest first, each [u; y].
  /// @return ψ_t, n × as many. Allocates only where their number changes.
  const Eigen::MatrixXd& Fit(const double* parameters, const Eigen::MatrixXd& windows);

  /// Covariance of ψ_t of window `column` of the last Fit, of at most `width` windows: what is left to know behind the window.
  Eigen::MatrixXd Covariance(int32_t column) const;

 private:
  /// A point ψ_s of one window with what is known there.
  struct Point {
    Eigen::VectorXd start, end, gradient;
    Eigen::MatrixXd information, sensitivity;
    double cost = 0;
  };
  /// Where one window stands; when it is done its place goes to the next that waits.
  struct Place {
    Point best, trial;
    Eigen::Index window = kNone;
    int passes = 0;
    double damping = 0;
  };
  static constexpr Eigen::Index kNone = -1;

  void Begin(Place* place, Eigen::Index window, const Eigen::MatrixXd& windows);
  void Evaluate(const double* parameters, const Eigen::MatrixXd& windows);
  bool Judge(Place* place);
  void Propose(Place* place);

  int32_t latent_size_, input_size_, output_size_, window_, width_;
  int32_t input_shift_;  // of the step's input behind the sample it starts from
  Eigen::MatrixXd start_precision_, guess_;
  Eigen::VectorXd weights_;
  std::optional<autodiff::Executable<double>> step_;
  std::optional<autodiff::Arena<double>> arena_;
  std::vector<Place> places_;
  Eigen::MatrixXd carry_, next_, input_, output_, by_carry_next_, by_carry_output_, result_, damped_, product_;
  Eigen::VectorXd row_, step_vector_;
};

}  // namespace metaekf::nssm
