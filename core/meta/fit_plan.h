#pragma once

#include <optional>
#include <vector>

#include "core/meta/map_fit.h"
#include "core/nssm/prior.h"

namespace metaekf::meta {

/// What has to be fitted to adapt a model to one system: its dynamics, and where the start is free the encoder
/// afterwards, on rollouts that start from windows, with the dynamics as they are.
struct FitPlan {
  FitPlan(const nssm::Model& model, const nssm::LossSpec& loss, const nn::Mask& adapted);

  nssm::RolloutLeastSquares dynamics;
  std::optional<nssm::RolloutLeastSquares> encoder;
  std::optional<nssm::RolloutLeastSquares> start;  ///< of a free start: c₀ alone

  /// Checks that a prior is one of these unknowns. Errors: InvalidArgument naming what does not fit.
  absl::Status CheckPrior(const nssm::GaussianPrior& prior) const;
  /// The beliefs of a prior about the mean ω.
  Belief DynamicsBelief(const nssm::GaussianPrior& prior, const std::vector<double>& mean) const;
  Belief EncoderBelief(const nssm::GaussianPrior& prior, const std::vector<double>& mean) const;
};

/// The most probable parameters of one system.
struct SystemFit {
  std::vector<double> parameters;  ///< ω
  MapFit dynamics;
  std::optional<MapFit> encoder;
};

struct SystemFitOptions {
  int32_t steps = 60;     ///< Levenberg–Marquardt steps at most, of each fit
  double tolerance = 1e-4;
};

/// Fits a system under a prior.
///
/// The start is the best of the mean and the prior's examples: every one's own start c₀ is fitted to the first samples,
/// the most probable few go on for some steps, the best of them to the end.
///
/// @param mean        ω₀.
/// @param normalised  the context, in normalised units.
/// @param on_step     called with (step, Φ) after every step of the fits; false stops, with the best so far.
/// Errors: FailedPrecondition if the context is too short; OutOfRange if no start gives a finite cost.
absl::StatusOr<SystemFit> FitSystem(const FitPlan& plan, const nssm::GaussianPrior& prior, const std::vector<double>& mean,
                                    const data::Trajectory& normalised, const SystemFitOptions& options,
                                    const std::function<bool(int, double)>& on_step);

}  // namespace metaekf::meta
