#pragma once

#include <vector>

#include "core/base/executor.h"
#include "core/data/trajectory.h"
#include "core/filter/filter_model.h"

namespace metaekf::filter {

/// A recording of a system, with the parameters of the model that is to follow it.
struct CalibrationRun {
  std::vector<double> parameters;
  Eigen::MatrixXd directions;   ///< V in which they are not known (UnknownDirections); empty: they are
  data::Trajectory trajectory;  ///< physical units; Case II with states
  /// Whether the fleet's model has been trained on the system: it may know such a system better than a new one.
  bool trained_on = false;
  bool width_only = false;  ///< it says only how wide bounds must be, for which one filter does
};

/// Of a system that `adapted` has been adapted to.
CalibrationRun RunOf(const nssm::Bundle& adapted, data::Trajectory trajectory);

/// Q and R with which filters explain recordings best.
///
/// A residual's second moment is the right Q only if model errors are white. Those of an adapted model are not: they last, and a
/// filter that takes them for white noise believes itself too much. What residuals show to last is in the noise's biases; how much
/// of it matters, and what they do not show, filters say. So all of the noise is scaled with numbers d > 0 of their own, Q = D_q Q₀ D_q
/// and R = D_r R₀ D_r with diagonal D, of each bias W = d W₀ and τ = d² τ₀, its time constant −1/ln φ, and, of a fleet, σ = d σ₀ of the
/// parameters, until the innovations of the filters are most likely,
///
///   max over d of  mean over runs of  1/T Σ_t [ ln N(ỹ_t; 0, S_t) + Σ_i ln N(x_{t,i}; x̂_{t,i}, P_{t,ii}) ] − Σ (ln d²)²/(2 s²),
///
/// where beyond 3 deviations squares of errors go over into straight lines (Huber): one filter that has lost track must not be all that
/// counts. The sum is over states i in Case II, where they are recorded and filters begin at the first of them. In Case I, whose
/// latents have no axes of their own, D_q is a multiple of the identity. In this order:
///
///   1. of a fleet, all of Q and all of R move in great steps while that helps: where filters lose track, little steps lead nowhere;
///   2. in Case II, every entry of D moves in proportion to the errors of its own;
///   3. in ln d², all of Q, all of R and then every number go to the tops of parabolas through three values each, until a round is worth
///      less than 1e-3 a number, of a fleet six times and else twice at most, on the beginnings of recordings alone where there are many numbers;
///   4. where these were only beginnings, 2 once more: some errors take long to grow;
///   5. of a fleet, all this on each half of the runs, every other one; the geometric mean of what both give is widened, Q ← e^w Q and so on,
///      with w the mean over systems of what it takes until bounds of 95 % hold 95 % of their errors (of states in Case II, else innovations):
///      those of one half by the noise of the other, those of runs that are only for this by the mean of both. w ≥ 0 for innovations. Likelihood
///      tempers the errors of the few systems that a model does not follow well, bounds must not;
///   6. where the model has been trained on some of the systems, w is δ̂ more: with v_i = ln of the mean square of system i's errors in
///      their ratio to what was expected, δ = mean of v over the systems not trained on − mean over all, ε its standard error, and
///      δ̂ = max(0, 1 − ε²/δ²) δ (James and Stein), 0 for δ < 0: what may well be chance is not taken for a difference.
///
/// How well bounds hold on new systems differs from fleet to fleet as much as its systems do among each other, so that many systems matter:
/// 8, 16 and 80 held-out vehicles of localization gave bounds of 95 % that held 82, 90 and 92 % on new ones, without step 5.
///
/// @param bundle  with Q₀, R₀ and P₀ in its noise. @param runs  at least one, of a fleet of many systems, or of one system's
///   samples that come after those that the parameters were fitted to. @param log_std  s of ln d², beside the mean over
///   samples; infinite: a fleet's, as far as the recordings say.
/// @return the noise, scaled; as it was where no filter stays finite, and for s = 0.
/// Source: maximum likelihood of innovations, e.g. R. K. Mehra, IEEE Trans. Autom. Control 15 (1970) 175; the scaling is ours.
nssm::FilterNoise Calibrate(const nssm::Bundle& bundle, const std::vector<CalibrationRun>& runs, double log_std, base::Executor* executor);

/// How filters with a bundle's noise explain recordings.
struct Explanation {
  double likelihood = 0;       ///< what Calibrate makes largest, without its prior, per sample, mean over runs; −∞ where a filter does not stay finite
  std::vector<double> ratios;  ///< |error| in its ratio to its deviation, of states in Case II, else of innovations; of filters that stay finite
};
Explanation Explain(const nssm::Bundle& bundle, const std::vector<CalibrationRun>& runs, base::Executor* executor);

/// ln of the factor by which variances must grow until bounds of 95 % hold 95 % of the errors: w of Calibrate. @return 0 without ratios.
double LogWidening(std::vector<double> ratios);

/// All variances times e^w: Q, R, what lasts, and what is not known of parameters.
nssm::FilterNoise Widened(nssm::FilterNoise noise, double log_widening);

}  // namespace metaekf::filter
