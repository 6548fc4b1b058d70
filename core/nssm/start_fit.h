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
/// by Levenberg–Marquardt from the prior's guess with exact Jacobians, several windows side by side. In double, normalised units.
/// One thread at a time; Fit does not allocate.
class StartFit {
 public:
  /// @param prior  its `start` is Λ, its `noise_variance` σ², its `start_guess` where the fit begins. @param width  windows side by side.
  StartFit(const Model& model, const GaussianPrior& prior, int32_t width);

  /// @param windows  start_size() × width, samples oldest first, each [u; y]. Columns beyond `count` are not read.
  /// @return ψ_t, n × width.
  const Eigen::MatrixXd& Fit(const double* parameters, const Eigen::MatrixXd& windows, int32_t count);

  /// Covariance of ψ_t of window `column` of the last Fit: what is left to know behind the window.
  Eigen::MatrixXd Covariance(int32_t column) const;

 private:
  /// A point ψ_s of one window with what is known there.
  struct Point {
    Eigen::VectorXd start, end, gradient;
    Eigen::MatrixXd information, sensitivity;
    double cost = 0;
  };
  void Evaluate(const double* parameters, const Eigen::MatrixXd& windows, int32_t count);

  int32_t latent_size_, input_size_, output_size_, window_, width_;
  int32_t input_shift_;  // of the step's input behind the sample it starts from
  Eigen::MatrixXd start_precision_, guess_;
  Eigen::VectorXd weights_;
  std::optional<autodiff::Executable<double>> step_;
  std::optional<autodiff::Arena<double>> arena_;
  std::vector<Point> best_, trial_;
  std::vector<double> damping_;
  Eigen::MatrixXd carry_, next_, input_, output_, by_carry_next_, by_carry_output_, result_, damped_, product_;
  Eigen::VectorXd row_, step_vector_;
};

}  // namespace metaekf::nssm
