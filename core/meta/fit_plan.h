#pragma once

#include <optional>
#include <vector>

#include "core/base/executor.h"
#include "core/meta/fit_progress.h"
#include "core/meta/map_fit.h"
#include "core/nssm/prior.h"

namespace metaekf::meta {

/// The least-squares problems behind an adaptation.
struct FitPlan {
  FitPlan(const nssm::Model& model, const nssm::LossSpec& loss, const nn::Mask& adapted);

  nssm::RolloutLeastSquares dynamics;              ///< of the adapted parameters, and c₀ where the start is fitted
  std::optional<nssm::RolloutLeastSquares> start;  ///< there: of c₀ alone

  /// Checks that a prior is one of these unknowns. Errors: InvalidArgument naming what does not fit.
  absl::Status CheckPrior(const nssm::GaussianPrior& prior) const;
  /// The belief of a prior about the mean ω.
  Belief BeliefOf(const nssm::GaussianPrior& prior, const std::vector<double>& mean) const;
};

/// The most probable parameters of one system.
struct SystemFit {
  std::vector<double> parameters;  ///< ω
  MapFit fit;
};

struct SystemFitOptions {
  int32_t steps = 60;     ///< Levenberg–Marquardt steps at most, of each fit
  double tolerance = 1e-4;
  /// How many samples' worth of evidence the prior's noise variance counts for; infinite: it is not estimated.
  double noise_samples = 200;
  /// Unknowns of a fit to the head of the same recording: the fit goes on from them alone. Empty: it looks for a start.
  Eigen::VectorXd from;
  base::Executor* executor = base::CallingThread();  ///< runs starts that compete
};

/// Fits a system under a prior: where it has loadings, along those alone (ω = ω₀ + V z, MapFit::coordinates being z and c₀).
///
/// It starts from the mean and from those of the prior's examples under which the first samples are most probable, each with
/// a start c₀ fitted to them. All go on for some steps, the best of them to the end.
///
/// @param mean        ω₀.
/// @param normalised  the context, in normalised units.
/// @param on_step     called by one thread at a time; false stops all fits, with the best so far.
/// Errors: FailedPrecondition if the context is too short; OutOfRange if no start gives a finite cost.
absl::StatusOr<SystemFit> FitSystem(const FitPlan& plan, const nssm::GaussianPrior& prior, const std::vector<double>& mean,
                                    const data::Trajectory& normalised, const SystemFitOptions& options,
                                    const OnFitStep& on_step);

}  // namespace metaekf::meta
