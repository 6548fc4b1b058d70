#include "core/meta/adapt.h"

#include <cmath>

#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/data/split.h"
#include "core/filter/calibrate.h"
#include "core/linalg/decompositions.h"
#include "core/meta/adam.h"
#include "core/meta/arx.h"
#include "core/meta/fit_plan.h"
#include "core/meta/inner_loop.h"
#include "core/meta/proximal_fit.h"
#include "core/meta/scratch_fit.h"
#include "core/nssm/loss.h"

namespace metaekf::meta {
namespace {

using data::Trajectory;
using nssm::Bundle;
using nssm::LossData;
using nssm::LossFunction;
using nssm::LossShape;

using OnStep = std::function<bool(const AdaptationStep&)>;

// A loss over a long context takes at most this many predicted samples at a time into memory: rollouts start further
// apart then.
// How far Q and R of a system may be from the fleet's. Of 60 oscillators whose filters ran on, 1 for Q explains the states best: 0.3 is no
// better than the fleet's noise, 3 makes the few samples of a tail count for too much. For R, 2 is a compromise: with noise ten times
// the fleet's bounds of 95 % hold the truth for 69, 81, 84, 86 % of samples at 1, 2, 3, 5, with the fleet's own for 94.0, 93.7, 93.7, 93.6 %.
constexpr int64_t kMaxColumns = 1 << 17;

constexpr int32_t kTailChecks = 50;    // of a trial that may stop early
constexpr int32_t kScratchSteps = 10;  // times those of an adaptation, as the paper allows its baseline
constexpr double kScratchLearningRate = 3e-3;
constexpr double kAdamLearningRate = 1e-3;
constexpr int32_t kLevenbergMarquardtSteps = 60;
constexpr double kUnknownNoiseVariance = 1e-2;  // normalised units
constexpr double kTrialTolerance = 1e-3;        // the last tenths of a per cent do not show in errors on a tail

absl::Status CheckFinite(const std::string& signal, const Eigen::MatrixXd& values) {
  for (Eigen::Index t = 0; t < values.cols(); ++t) {
    for (Eigen::Index i = 0; i < values.rows(); ++i) {
      if (std::isfinite(values(i, t))) continue;
      return absl::InvalidArgumentError(absl::StrCat("context: ", signal, " ", i + 1, " of sample ", t, " is ",
                                                     base::FormatExact(values(i, t)), "; adaptation needs every value"));
    }
  }
  return absl::OkStatus();
}

struct FitResult {
  std::vector<double> parameters;
  double loss_before = 0, loss_after = 0;
  std::optional<nssm::GaussianPosterior> posterior;
  Eigen::VectorXd unknowns;  // of Levenberg–Marquardt
};

absl::Status Diverged(int32_t step, double loss, double learning_rate) {
  return absl::OutOfRangeError(absl::StrCat("the adaptation diverged: the loss is ", base::FormatShort(loss), " after ", step,
                                            " steps with learning rate ", base::FormatShort(learning_rate),
                                            "; a smaller learning rate may help"));
}

/// The steps of InnerLoop, in double whatever the model's precision.
class GradientSteps {
 public:
  GradientSteps(const AdaptationOptions& options, const nn::ParameterLayout& layout, double pull,
                const std::vector<double>& start)
      : adam_(options.method != AdaptationMethod::kGradientDescent),
        layout_(layout),
        rates_(RatesOfTensors(options.inner_loop, layout)),
        pull_(pull),
        start_(start),
        m_(start.size()),
        v_(start.size()) {}

  /// @param gradient  zero in what does not adapt. @param step  counts from 1.
  template <typename T>
  void Step(int32_t step, const std::vector<T>& gradient, std::vector<double>* parameters) {
    const AdamCorrections corrections(step);
    for (size_t l = 0; l < rates_.size(); ++l) {
      const nn::Tensor& tensor = layout_.tensors()[l];
      for (size_t i = static_cast<size_t>(tensor.offset); i < static_cast<size_t>(tensor.offset + tensor.size()); ++i) {
        double& value = (*parameters)[i];
        const double g = static_cast<double>(gradient[i]) + (adam_ ? pull_ * (value - start_[i]) : 0);
        value -= rates_[l] * (adam_ ? AdamDirection(g, corrections, &m_[i], &v_[i]) : g);
        if (!adam_ && pull_ > 0) value = start_[i] + (value - start_[i]) / (1 + rates_[l] * pull_);
      }
    }
  }

 private:
  const bool adam_;
  const nn::ParameterLayout& layout_;
  const std::vector<double> rates_;  // of every tensor
  const double pull_;                // λ
  const std::vector<double> start_;
  std::vector<double> m_, v_;
};

/// Looks at the parameters after a step.
using Inspect = std::function<void(int32_t step, const std::vector<double>& parameters)>;

/// Runs the adaptation on one piece of context in normalised units. @param pull  λ of ½ λ |ω − ω₀|² beside the loss.
template <typename T>
absl::StatusOr<FitResult> Fit(const Bundle& bundle, nssm::LossSpec loss, double pull, const Trajectory& context,
                              const nn::Mask& mask, const AdaptationOptions& options, const OnStep& on_step,
                              const Inspect& inspect) {
  const nssm::ModelSpec& spec = bundle.model.spec();
  METAEKF_ASSIGN_OR_RETURN(LossShape shape, nssm::ShapeOfLoss(spec, loss, context.length()));
  const int64_t columns = int64_t{shape.rollouts} * shape.horizon;
  if (shape.rollouts > 1 && columns > kMaxColumns) {
    loss.stride *= static_cast<int32_t>((columns + kMaxColumns - 1) / kMaxColumns);
    METAEKF_ASSIGN_OR_RETURN(shape, nssm::ShapeOfLoss(spec, loss, context.length()));
  }
  const LossFunction<T> function(bundle.model, loss, shape, mask, mask, nssm::HessianProducts::kNone);
  auto scratch = function.MakeScratch(options.executor);
  const LossData<T> data = nssm::CutLossData<T>(spec, loss, context, 0, shape);
  FitResult result;
  result.parameters = options.method == AdaptationMethod::kFromScratch ? bundle.model.InitialParameters(options.seed)
                                                                       : bundle.parameters;
  nssm::RoundToPrecision(spec.precision, &result.parameters);
  std::vector<T> typed(result.parameters.begin(), result.parameters.end()), typed_gradient(typed.size());
  GradientSteps stepper(options, bundle.model.layout(), pull, result.parameters);
  const int32_t steps = options.inner_loop.steps;
  for (int32_t step = 0; step <= steps; ++step) {
    const double value = step < steps ? function.Gradient(typed.data(), data, typed_gradient.data(), &scratch)
                                      : function.Value(typed.data(), data, &scratch);
    if (!std::isfinite(value)) return Diverged(step, value, options.inner_loop.learning_rate);
    (step == 0 ? result.loss_before : result.loss_after) = value;
    if (step > 0 && on_step && !on_step({.step = step, .steps = steps, .loss = value})) return absl::CancelledError("the adaptation was cancelled");
    if (step == steps) break;
    stepper.Step(step + 1, typed_gradient, &result.parameters);
    nssm::RoundToPrecision(spec.precision, &result.parameters);
    typed.assign(result.parameters.begin(), result.parameters.end());
    if (inspect) inspect(step + 1, result.parameters);
  }
  if (steps == 0) result.loss_after = result.loss_before;
  return result;
}

/// What stands in where no prior has been learned: N(ω₀, I/λ), and noise that the fit has yet to find out.
nssm::GaussianPrior ProximalPrior(const FitPlan& plan, double proximal) {
  const auto identity = [](Eigen::Index n) { return Eigen::MatrixXd(Eigen::MatrixXd::Identity(n, n)); };
  nssm::GaussianPrior prior{.dynamics = proximal * identity(plan.dynamics.adapted_size()),
                            .noise_variance = Eigen::VectorXd::Constant(plan.dynamics.channels(), kUnknownNoiseVariance)};
  if (plan.start) prior.start = identity(plan.start->carry_size());
  return prior;
}

/// What is to be minimised over what.
struct Problem {
  nssm::LossSpec loss;
  double pull = 0;  // λ of what IMPLICIT_MAML minimises in training too
  bool trained_at_minimum = false;  // by LEVENBERG_MARQUARDT
  nn::Mask mask;
  Trajectory context;  // found fit for adaptation
  // Of Levenberg–Marquardt: when it ends, and unknowns of a fit to the head of the context to go on from.
  double tolerance = SystemFitOptions().tolerance;
  Eigen::VectorXd from;
};

/// What the information about [ω; c₀], or [z; c₀], says of ω or z: the Schur complement integrates c₀ out.
absl::StatusOr<nssm::GaussianPosterior> PosteriorOf(const MapFit& fit, Eigen::Index starts) {
  const Eigen::MatrixXd& information = fit.information;
  const Eigen::Index adapted = information.rows() - starts;
  nssm::GaussianPosterior posterior{information.topLeftCorner(adapted, adapted)};
  if (fit.coordinates.size() > 0) posterior.coordinates = fit.coordinates.head(adapted);
  if (starts == 0) return posterior;
  const linalg::Cholesky factor(information.bottomRightCorner(starts, starts));
  if (!factor.ok()) return absl::OutOfRangeError("the adaptation diverged: the start of the context is not determined");
  const auto cross = information.bottomLeftCorner(starts, adapted);
  const Eigen::MatrixXd determined = posterior.information - cross.transpose() * factor.Solve(Eigen::MatrixXd(cross));
  posterior.information = determined.selfadjointView<Eigen::Lower>();  // rounding leaves it not quite symmetric
  return posterior;
}

/// Levenberg–Marquardt, in double whatever the model's precision.
absl::StatusOr<FitResult> FitByLevenbergMarquardt(const Bundle& bundle, const Problem& problem, const Trajectory& context,
                                                  const AdaptationOptions& options, const OnStep& on_step) {
  const FitPlan plan(bundle.model, problem.loss, problem.mask);
  const nssm::GaussianPrior prior = bundle.prior ? *bundle.prior : ProximalPrior(plan, options.inner_loop.proximal);
  const int32_t steps = options.inner_loop.steps;
  METAEKF_ASSIGN_OR_RETURN(const nssm::LossData<double> data, plan.dynamics.Cut(context));
  const double values = static_cast<double>(data.outputs.size());
  // Told: the mean square of the weighted residuals, in units of the noise.
  const auto per_value = [&](double cost) { return 2 * cost / values; };
  bool stopped = false;
  int32_t step = 0;
  const auto tell = [&](int, double cost) {
    step = std::min(step + 1, steps);
    stopped = on_step && !on_step({.step = step, .steps = steps, .loss = per_value(cost)});
    return !stopped;
  };
  METAEKF_ASSIGN_OR_RETURN(
      SystemFit fit, options.method == AdaptationMethod::kFromScratch
                         ? FitFromScratch(plan, bundle.model, problem.loss, context, {.seed = options.seed, .steps = steps, .stop_early = true, .executor = options.executor}, tell)
                         : FitSystem(plan, prior, bundle.parameters, context, {.steps = steps, .tolerance = problem.tolerance, .from = problem.from, .executor = options.executor}, tell));
  if (stopped) return absl::CancelledError("the adaptation was cancelled");
  FitResult result{.parameters = std::move(fit.parameters), .unknowns = fit.fit.unknowns};
  METAEKF_ASSIGN_OR_RETURN(result.posterior, PosteriorOf(fit.fit, prior.start.rows()));
  result.posterior->mask = problem.mask;
  nssm::RoundToPrecision(bundle.model.spec().precision, &result.parameters);
  nssm::RolloutLeastSquares::Workspace workspace(plan.dynamics, data.shape);
  const Eigen::VectorXd weights = prior.noise_variance.cwiseInverse();
  const auto loss_at = [&](const std::vector<double>& parameters, const Eigen::VectorXd& start) {
    return per_value(plan.dynamics.Cost(parameters.data(), start, weights, data, &workspace));
  };
  const Eigen::VectorXd start = fit.fit.unknowns.tail(prior.start.rows());
  result.loss_before = loss_at(bundle.parameters, Eigen::VectorXd::Zero(start.size()));
  result.loss_after = loss_at(result.parameters, start);
  return result;
}

/// The minimum that a model of IMPLICIT_MAML was trained with, in double whatever the model's precision.
absl::StatusOr<FitResult> FitToMinimum(const Bundle& bundle, const Problem& problem, const Trajectory& context,
                                       const AdaptationOptions& options, const OnStep& on_step) {
  const nssm::RolloutLeastSquares least_squares(bundle.model, problem.loss, problem.mask, false);
  METAEKF_ASSIGN_OR_RETURN(const nssm::LossData<double> data, least_squares.Cut(context));
  nssm::RolloutLeastSquares::Workspace workspace(least_squares, data.shape);
  const Eigen::VectorXd weights = VarianceOfLoss(least_squares, problem.loss, data).cwiseInverse();
  const auto loss_at = [&](const std::vector<double>& parameters) {
    return least_squares.Cost(parameters.data(), Eigen::VectorXd(), weights, data, &workspace);
  };
  FitResult result{.parameters = bundle.parameters, .loss_before = loss_at(bundle.parameters)};
  if (!std::isfinite(result.loss_before)) {
    return absl::OutOfRangeError("the adaptation diverged: the meta-learned parameters do not simulate this system");
  }
  const int32_t steps = options.inner_loop.steps;
  const auto tell = [&](int step, double cost, const Eigen::VectorXd&) { return !on_step || on_step({.step = step, .steps = steps, .loss = cost}); };
  const MapFit fit = FitProximal(least_squares, problem.loss, data, bundle.parameters,
                                 {.proximal = problem.pull, .steps = steps}, &workspace, tell);
  if (fit.stopped) return absl::CancelledError("the adaptation was cancelled");
  ScatterAdapted(least_squares, fit.unknowns, &result.parameters);
  nssm::RoundToPrecision(bundle.model.spec().precision, &result.parameters);
  result.loss_after = loss_at(result.parameters);
  return result;
}

absl::StatusOr<FitResult> FitAnyPrecision(const Bundle& bundle, const Problem& problem, const Trajectory& context,
                                          const AdaptationOptions& options, const OnStep& on_step,
                                          const Inspect& inspect = nullptr) {
  METAEKF_ASSIGN_OR_RETURN(const Trajectory normalised, data::Normalised(bundle.normaliser, context));
  if (options.method == AdaptationMethod::kLevenbergMarquardt && problem.trained_at_minimum) {
    return FitToMinimum(bundle, problem, normalised, options, on_step);
  }
  if (options.method == AdaptationMethod::kLevenbergMarquardt || bundle.model.spec().fits_start()) {
    return FitByLevenbergMarquardt(bundle, problem, normalised, options, on_step);
  }
  return bundle.model.spec().precision == nssm::Precision::kFloat32
             ? Fit<float>(bundle, problem.loss, problem.pull, normalised, problem.mask, options, on_step, inspect)
             : Fit<double>(bundle, problem.loss, problem.pull, normalised, problem.mask, options, on_step, inspect);
}

absl::StatusOr<TailErrors> ErrorsOf(const Bundle& bundle, const Trajectory& tail) {
  TailErrors errors;
  for (const bool simulate : {false, true}) {
    METAEKF_ASSIGN_OR_RETURN(
        const nssm::Prediction prediction,
        nssm::Predict(bundle, tail, simulate ? nssm::PredictionMode::kSimulate : nssm::PredictionMode::kOneStep));
    (simulate ? errors.simulate : errors.one_step) = nssm::ScorePredictions({tail.outputs}, {prediction.outputs}).rmse;
  }
  return errors;
}

/// The largest order up to the default that the samples allow; the errors stay empty if none does.
TailErrors ArxErrors(const Trajectory& head, const Trajectory& tail, int64_t warmup) {
  TailErrors errors;
  for (int order = ArxModel::kDefaultOrder; order >= 1; --order) {
    const absl::StatusOr<ArxModel> arx = ArxModel::Fit(head, order);
    if (!arx.ok() || tail.length() <= std::max<int64_t>(order, warmup)) continue;
    errors.one_step = nssm::ScorePredictions({tail.outputs}, {arx->Predict(tail, false, warmup)}).rmse;
    errors.simulate = nssm::ScorePredictions({tail.outputs}, {arx->Predict(tail, true, warmup)}).rmse;
    break;
  }
  return errors;
}

absl::StatusOr<Problem> Pose(const Bundle& bundle, const Trajectory& context, const AdaptationOptions& options) {
  const nssm::ModelSpec& spec = bundle.model.spec();
  METAEKF_ASSIGN_OR_RETURN(const TrainingSpec training, ReadTrainingSpec(*bundle.training));
  METAEKF_RETURN_IF_ERROR(nssm::CheckChannels(bundle, context, !spec.is_case_one()));
  if (spec.fits_start() && (options.method == AdaptationMethod::kGradientDescent || options.method == AdaptationMethod::kAdam)) {
    return absl::InvalidArgumentError("method: the start of the model is fitted, so it adapts by Levenberg–Marquardt (map) or from scratch");
  }
  METAEKF_RETURN_IF_ERROR(CheckFinite("input", context.inputs));
  METAEKF_RETURN_IF_ERROR(CheckFinite("output", context.outputs));
  if (!spec.is_case_one()) METAEKF_RETURN_IF_ERROR(CheckFinite("state", context.states));
  const int64_t needed = ContextSamplesNeeded(spec, training.loss);
  if (context.length() < needed) {
    return absl::FailedPreconditionError(absl::StrCat("the context is too short: ", context.length(), " samples given, ",
                                                      needed, " needed for the model's windows"));
  }
  Problem problem{.loss = training.loss, .context = context};
  METAEKF_ASSIGN_OR_RETURN(problem.mask, nn::ParseMask(options.inner_loop.adapted_mask, bundle.model.layout()));
  METAEKF_RETURN_IF_ERROR(CheckTensorRates(options.inner_loop, bundle.model.layout()));
  if (training.algorithm == Algorithm::kImplicitMaml && options.method != AdaptationMethod::kFromScratch) {
    problem.pull = options.inner_loop.proximal;
    problem.trained_at_minimum = training.inner_loop.optimiser == Optimiser::kLevenbergMarquardt;
  }
  if (spec.is_case_one()) problem.context.states.resize(0, context.length());
  return problem;
}

AdaptationMethod MethodOf(Optimiser optimiser) {
  switch (optimiser) {
    case Optimiser::kGradientDescent:
      return AdaptationMethod::kGradientDescent;
    case Optimiser::kAdam:
      return AdaptationMethod::kAdam;
    case Optimiser::kLevenbergMarquardt:
      return AdaptationMethod::kLevenbergMarquardt;
  }
  return AdaptationMethod::kGradientDescent;
}

/// Rates for a method that the model is not meant for: those of training if it used the method, else `otherwise`.
void TakeRates(const InnerLoopSpec& training, AdaptationMethod method, double otherwise, InnerLoopSpec* inner_loop) {
  const bool trained_with = MethodOf(training.optimiser) == method;
  inner_loop->learning_rate = trained_with ? training.learning_rate : otherwise;
  inner_loop->tensor_rates.clear();
  if (trained_with) inner_loop->tensor_rates = training.tensor_rates;
}

/// The adaptation to the head of a context, and what it is worth on the tail.
struct Trial {
  TailErrors errors;
  int32_t steps = 0;  // after which they were reached
  Eigen::VectorXd unknowns;
  Bundle adapted;
};

/// Where nothing but the data holds the parameters back, the trial stops at the step that simulates the tail best, of
/// kTailChecks that are tried.
absl::StatusOr<Trial> RunTrial(const Bundle& bundle, const Problem& problem, const Trajectory& head, const Trajectory& tail,
                               const AdaptationOptions& options, const OnStep& on_step) {
  Trial trial{.steps = options.inner_loop.steps, .adapted = bundle};
  bool first = true;
  const int32_t period = std::max(1, options.inner_loop.steps / kTailChecks);
  const Inspect inspect = [&](int32_t step, const std::vector<double>& parameters) {
    if (step % period != 0 && step != options.inner_loop.steps) return;
    Bundle candidate = bundle;
    candidate.parameters = parameters;
    absl::StatusOr<TailErrors> errors = ErrorsOf(candidate, tail);
    if (!errors.ok() || (!first && !BetterInFreeRun(*errors, trial.errors))) return;
    trial = {*std::move(errors), step, {}, std::move(candidate)};
    first = false;
  };
  const bool stops_early = options.method == AdaptationMethod::kFromScratch;
  METAEKF_ASSIGN_OR_RETURN(FitResult fit, FitAnyPrecision(bundle, problem, head, options, on_step, stops_early ? inspect : nullptr));
  if (!first) return trial;
  trial.adapted.parameters = std::move(fit.parameters);
  trial.adapted.posterior = std::move(fit.posterior);
  trial.unknowns = std::move(fit.unknowns);
  METAEKF_ASSIGN_OR_RETURN(trial.errors, ErrorsOf(trial.adapted, tail));
  return trial;
}

/// The tail of a context, for a model adapted to its head.
filter::CalibrationRun TailOf(const Bundle& adapted, const Trajectory& context, Eigen::Index held_out_from) {
  // A filter's first window may reach into what has been seen: it is not what is judged.
  const int64_t begin = adapted.model.spec().is_case_one() ? std::max<int64_t>(0, held_out_from - adapted.model.spec().warmup()) : held_out_from;
  return filter::RunOf(adapted, *data::SamplesFrom(context, begin));
}

/// The noise of an adapted model from what it has not seen; the fleet's where that is how it is to be.
nssm::FilterNoise OwnNoise(const Bundle& adapted, const filter::CalibrationRun& tail, double log_std, base::Executor* executor) {
  if (adapted.noise.process.size() == 0 || log_std == 0) return adapted.noise;
  return filter::Widened(filter::Calibrate(adapted, {tail}, log_std, executor), adapted.noise.own_widening);
}

/// Samples of the context's end that are held out.
int64_t TailSamples(const nssm::ModelSpec& model, int64_t samples) {
  return std::max<int64_t>(samples / 5, model.warmup() + 1);
}

}  // namespace

bool BetterInFreeRun(const TailErrors& a, const TailErrors& b) {
  double log_a = 0, log_b = 0;
  for (const double error : a.simulate) log_a += std::log(error);
  for (const double error : b.simulate) log_b += std::log(error);
  if (a.simulate.empty() || !std::isfinite(log_a)) return false;
  return b.simulate.empty() || !std::isfinite(log_b) || log_a < log_b;
}

absl::StatusOr<AdaptationOptions> DefaultAdaptation(const Bundle& bundle, std::optional<AdaptationMethod> method) {
  const absl::StatusOr<TrainingSpec> training = ReadTrainingSpec(*bundle.training);
  if (!training.ok()) {
    return absl::FailedPreconditionError(
        absl::StrCat("the model does not say how it was trained: ", std::string(training.status().message())));
  }
  AdaptationOptions options{.inner_loop = training->adaptation};
  const AdaptationMethod trained_for = MethodOf(options.inner_loop.optimiser);
  options.method = method.value_or(trained_for);
  if (options.method == AdaptationMethod::kFromScratch) {
    if (!bundle.model.spec().fits_start()) options.inner_loop.steps *= kScratchSteps;
    options.inner_loop.learning_rate = kScratchLearningRate;
    options.inner_loop.tensor_rates.clear();
    options.inner_loop.adapted_mask = "*";
  } else if (options.method == AdaptationMethod::kAdam && trained_for != AdaptationMethod::kAdam) {
    TakeRates(training->inner_loop, options.method, kAdamLearningRate, &options.inner_loop);
  } else if (options.method == AdaptationMethod::kLevenbergMarquardt && trained_for != options.method) {
    options.inner_loop.steps = kLevenbergMarquardtSteps;
  } else if (options.method == AdaptationMethod::kGradientDescent && trained_for != options.method) {
    TakeRates(training->inner_loop, options.method, InnerLoopSpec().learning_rate, &options.inner_loop);
  }
  return options;
}

int64_t ContextSamplesNeeded(const nssm::ModelSpec& model, const nssm::LossSpec& loss) {
  return nssm::SamplesNeeded(model, loss) + model.warmup() + 1;
}

absl::StatusOr<Bundle> AdaptedBundle(Bundle bundle, const Trajectory& context, const AdaptationOptions& options) {
  METAEKF_ASSIGN_OR_RETURN(const Problem problem, Pose(bundle, context, options));
  METAEKF_ASSIGN_OR_RETURN(FitResult fit,
                           FitAnyPrecision(bundle, problem, problem.context, options, nullptr));
  bundle.parameters = std::move(fit.parameters);
  bundle.posterior = std::move(fit.posterior);
  return bundle;
}

absl::StatusOr<std::vector<nssm::FilterNoise>> NoiseOfContext(const Bundle& bundle, const Trajectory& context,
                                                              const AdaptationOptions& options, const std::vector<double>& log_stds) {
  METAEKF_ASSIGN_OR_RETURN(Problem problem, Pose(bundle, context, options));
  const Eigen::Index held_out_from = context.length() - TailSamples(bundle.model.spec(), context.length());
  METAEKF_ASSIGN_OR_RETURN(const Trajectory head, data::FirstSamples(problem.context, held_out_from));
  problem.tolerance = kTrialTolerance;
  METAEKF_ASSIGN_OR_RETURN(FitResult fit, FitAnyPrecision(bundle, problem, head, options, nullptr));
  std::vector<nssm::FilterNoise> noises;
  Bundle adapted = bundle;
  adapted.parameters = std::move(fit.parameters);
  adapted.posterior = std::move(fit.posterior);
  const filter::CalibrationRun tail = TailOf(adapted, context, held_out_from);
  for (const double log_std : log_stds) noises.push_back(OwnNoise(adapted, tail, log_std, options.executor));
  return noises;
}

absl::StatusOr<AdaptationResult> Adapt(const Bundle& bundle, const Trajectory& context,
                                       const AdaptationOptions& options, const OnStep& on_step) {
  const nssm::ModelSpec& spec = bundle.model.spec();
  METAEKF_ASSIGN_OR_RETURN(Problem problem, Pose(bundle, context, options));
  AdaptationResult result;
  result.mask = problem.mask;
  result.context_samples = context.length();
  result.tail_samples = TailSamples(spec, context.length());
  const Eigen::Index held_out_from = context.length() - result.tail_samples;
  METAEKF_ASSIGN_OR_RETURN(const Trajectory head, data::FirstSamples(problem.context, held_out_from));
  METAEKF_ASSIGN_OR_RETURN(const Trajectory tail, data::SamplesFrom(problem.context, held_out_from));

  METAEKF_ASSIGN_OR_RETURN(result.before, ErrorsOf(bundle, tail));
  problem.tolerance = kTrialTolerance;
  const OnStep on_trial_step = [&](AdaptationStep step) {
    step.trial = true;
    return !on_step || on_step(step);
  };
  METAEKF_ASSIGN_OR_RETURN(Trial trial, RunTrial(bundle, problem, head, tail, options, on_trial_step));
  result.after = std::move(trial.errors);
  result.arx = ArxErrors(head, tail, spec.warmup());

  AdaptationOptions whole = options;
  whole.inner_loop.steps = result.steps = trial.steps;
  problem.from = std::move(trial.unknowns);
  problem.tolerance = SystemFitOptions().tolerance;
  const auto find_noise = [&](base::Executor* executor) {
    result.noise = OwnNoise(trial.adapted, TailOf(trial.adapted, context, held_out_from), bundle.noise.log_std, executor);
  };
  absl::StatusOr<FitResult> fit;
  const auto fit_whole = [&](base::Executor* executor) {
    whole.executor = executor;
    fit = FitAnyPrecision(bundle, problem, problem.context, whole, on_step);
  };
  if (options.method == AdaptationMethod::kFromScratch) {  // from several starts
    find_noise(options.executor);
    fit_whole(options.executor);
  } else {  // neither keeps more than one thread busy
    options.executor->ParallelFor(2, [&](size_t i, size_t) { i == 0 ? fit_whole(base::CallingThread()) : find_noise(base::CallingThread()); });
  }
  if (!fit.ok()) return fit.status();
  result.parameters = std::move(fit->parameters);
  result.posterior = std::move(fit->posterior);
  result.context_loss_before = fit->loss_before;
  result.context_loss_after = fit->loss_after;
  return result;
}

}  // namespace metaekf::meta
