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
/// by Levenberg–Marquardt with exact Jacobians, up to a tenth in ½ χ²: what is left to gain is a fraction of the standard
/// deviation that the data leaves (of a model that explains the window worse than the noise, its misfit is the unit). A window begins where the trajectory through its predecessor goes on. Unless it is then
/// explained about as well as that one was, it is fitted from the prior's guess and from 0 as well and the best is kept: the
/// guess is of the fleet's models, and one that was fitted from scratch has other latents.
/// In double, normalised units. One thread at a time.
class StartFit {
 public:
  /// How many windows side by side suit so many: those that follow each other are fitted one after the other.
  static int32_t WidthFor(Eigen::Index windows);

  /// @param prior  its `start` is Λ, its `noise_variance` σ², its `start_guess` the guess. @param width  windows side by side.
  StartFit(const Model& model, const GaussianPrior& prior, int32_t width);

  /// @param windows  start_size() × any number, samples oldest first, each [u; y]; each a sample later than the one before it,
  ///                 or it gains nothing from it.
  /// @return ψ_t, n × as many; the same whatever the width. Allocates only where their number changes.
  const Eigen::MatrixXd& Fit(const double* parameters, const Eigen::MatrixXd& windows);

  /// Covariance of ψ_t of the only window of the last Fit: what is left to know behind it.
  Eigen::MatrixXd Covariance() const;

 private:
  /// A point ψ_s of one window with what is known there.
  struct Point {
    Eigen::VectorXd start, second, end;  // ψ of the window's first, second and last sample
    Eigen::VectorXd gradient;
    Eigen::MatrixXd information, sensitivity;
    double cost = 0;
  };
  enum class Start { kContinued, kGuess, kOrigin };
  /// Where one window stands; it is followed by the others of its stretch, and these by a stretch that waits.
  struct Place {
    Eigen::Index window = kNone, stretch_end = 0;
    Start start = Start::kGuess;
    double reference = 0;  // cost of the window before
    Point best, trial;     // from this start
    Point fitted;          // from the starts that have been tried
    int steps = 0;
    double damping = 0, growth = 0;
    double promised = 0;  // decrease of the cost, by its quadratic model
  };
  static constexpr Eigen::Index kNone = -1;

  void BeginStretch(Place* place, Eigen::Index first, const Eigen::MatrixXd& windows);
  void BeginStart(Place* place, Start start, const Eigen::MatrixXd& windows);
  bool Advance(Place* place, const Eigen::MatrixXd& windows);
  void Evaluate(const double* parameters, const Eigen::MatrixXd& windows);
  void Accumulate();
  void Read(Eigen::Index column, Point* point) const;
  double UnitOf(double cost) const;
  bool Judge(Place* place) const;
  void Propose(Place* place);

  int32_t latent_size_, input_size_, output_size_, window_, width_;
  int32_t input_shift_;  // of the step's input behind the sample it starts from
  Eigen::MatrixXd start_precision_, guess_;
  Eigen::VectorXd weights_;
  std::optional<autodiff::Executable<double>> step_;
  std::optional<autodiff::Arena<double>> arena_;
  std::vector<Place> places_;
  // Of all places, one a column; tangents ∂/∂ψ_s in blocks of `width` columns, one for each component of ψ_s.
  Eigen::MatrixXd carry_, next_, second_, input_, output_, measured_, tangents_, next_tangents_, output_tangents_;
  // Sums over the window, one place a row; of the information the lower triangle, row by row.
  Eigen::ArrayXXd cost_, gradient_, information_, residual_, weighted_;
  Eigen::MatrixXd result_, damped_;
  Eigen::VectorXd step_vector_;
};

}  // namespace metaekf::nssm
