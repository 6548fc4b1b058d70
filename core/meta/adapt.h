#pragma once

#include <functional>
#include <optional>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/executor.h"
#include "core/data/trajectory.h"
#include "core/meta/training_spec.h"
#include "core/nssm/bundle.h"
#include "core/nssm/predict.h"

namespace metaekf::meta {

enum class AdaptationMethod {
  kGradientDescent,  ///< eq. maml_inner from the meta-learned parameters
  kAdam,             ///< the same loss and start, Adam steps
  /// Without the meta-learned parameters: the baseline. A model whose start is fitted by Levenberg–Marquardt from linear starts
  /// (FitFromScratch), any other by Adam from a random initialisation: exact fits of states measured for a few hundred samples
  /// extrapolate worse.
  kFromScratch,
  /// The most probable parameters under the model's prior (FitSystem); of a model that IMPLICIT_MAML has trained with this
  /// optimiser the minimum that it was trained with (FitProximal).
  kLevenbergMarquardt,
};

struct AdaptationOptions {
  AdaptationMethod method = AdaptationMethod::kGradientDescent;
  InnerLoopSpec inner_loop;
  uint64_t seed = 0;  ///< of the random initialisation
  base::Executor* executor = base::CallingThread();  ///< runs starts that compete, and gradients of large models; changes no result
};

/// What `adapt` does with a model unless told otherwise. Without a method: what its training specification says. The
/// baseline from scratch is given all parameters and, by Adam, ten times the steps.
/// Errors: FailedPrecondition if the model file does not say how it was trained.
absl::StatusOr<AdaptationOptions> DefaultAdaptation(const nssm::Bundle& bundle,
                                                    std::optional<AdaptationMethod> method = std::nullopt);

/// Root mean square errors of one model on the tail of a context, per output, in its unit.
struct TailErrors {
  std::vector<double> one_step;
  std::vector<double> simulate;
};

struct AdaptationResult {
  std::vector<double> parameters;  ///< ω_M
  nn::Mask mask;                   ///< which tensors may differ from the meta-learned ones
  int64_t context_samples = 0;
  int32_t steps = 0;               ///< taken: fewer than asked for where the trial on the head stopped early
  double context_loss_before = 0;  ///< normalised units
  double context_loss_after = 0;
  int64_t tail_samples = 0;        ///< held out for the errors below
  TailErrors before, after, arx;
  /// kLevenbergMarquardt; of the tensors of `mask`. None of IMPLICIT_MAML's minimum, whose loss is no likelihood.
  std::optional<nssm::GaussianPosterior> posterior;
  /// Q and R with which a filter explains the tail best, held near the model's own (filter::Calibrate).
  nssm::FilterNoise noise;
};

/// Whether `a` is better than `b` in free run, all outputs together (geometric mean of the ratios, for outputs may have
/// different units). What did not diverge is better than what did, or is not there.
bool BetterInFreeRun(const TailErrors& a, const TailErrors& b);

/// The adaptation alone: `bundle` with ω_M and its posterior from the whole context, all steps, without errors on a tail. Arguments and
/// errors as those of Adapt.
absl::StatusOr<nssm::Bundle> AdaptedBundle(nssm::Bundle bundle, const data::Trajectory& context, const AdaptationOptions& options);

/// Q and R as Adapt finds them on the tail, for each of several priors: FilterNoise::log_std. Arguments and errors as those of Adapt.
absl::StatusOr<std::vector<nssm::FilterNoise>> NoiseOfContext(const nssm::Bundle& bundle, const data::Trajectory& context,
                                                              const AdaptationOptions& options, const std::vector<double>& log_stds);

/// Where an adaptation stands.
struct AdaptationStep {
  bool trial = false;  ///< of the trial on the head of the context, whose only use is the errors on its tail
  int32_t step = 0;    ///< done, of `steps`
  int32_t steps = 0;
  double loss = 0;  ///< after the step, on what is being fitted to
};

/// Samples that an adaptation needs: enough for the loss on the head of the context and for predictions on its tail.
int64_t ContextSamplesNeeded(const nssm::ModelSpec& model, const nssm::LossSpec& loss);

/// Adapts a model to a new system (paper.tex algorithm alg:maml_inference).
///
/// The last fifth of the context is held out, the model adapted to the rest, and its errors on the tail noted beside
/// those of the unadapted model and of a linear ARX model fitted to the same samples. The adaptation that is
/// returned is then made from the whole context in the same way.
///
/// Gradient steps from scratch have neither prior nor meta-learned start to hold them back: the trial keeps the step that
/// simulates the tail best (its errors are the optimistic ones of a choice), and the adaptation takes as many.
///
/// @param context   one trajectory in physical units.
/// @param on_step   called after every step, first of the trial, then of the adaptation; false stops it.
/// Errors: FailedPrecondition if the context is too short, with the number needed; InvalidArgument for channels, NaN or
/// the mask; OutOfRange if the loss diverges, saying at which step; Cancelled if on_step said so.
absl::StatusOr<AdaptationResult> Adapt(const nssm::Bundle& bundle, const data::Trajectory& context,
                                       const AdaptationOptions& options,
                                       const std::function<bool(const AdaptationStep&)>& on_step);

}  // namespace metaekf::meta
