#include "core/meta/outer_loop.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <optional>

#include "core/base/numbers.h"
#include "core/base/rng.h"
#include "core/base/status.h"
#include "core/meta/adam.h"
#include "core/meta/meta_gradient.h"

namespace metaekf::meta {
namespace {

using data::Trajectory;
using nssm::LossData;
using nssm::LossShape;

constexpr int kValidationDraws = 2;          // context and target sets per held-out system
constexpr double kTrainingLossWeight = 0.1;  // of the newest step in the running mean
constexpr double kHopeless = 1e6;            // times the first loss: from there no training comes back

/// Along half a cosine from `start` to `end` while `step` goes from 0 to steps − 1.
double CosineDecay(double start, double end, int32_t step, int32_t steps) {
  const double share = steps > 1 ? static_cast<double>(step) / (steps - 1) : 1;
  return end + (start - end) * 0.5 * (1 + std::cos(std::numbers::pi * share));
}

double LearningRate(const TrainingSpec& spec, int32_t iteration) {
  const int32_t warmup = spec.warmup_iterations;
  return iteration < warmup
             ? CosineDecay(spec.warmup_lr, spec.outer_lr, iteration, warmup)
             : CosineDecay(spec.outer_lr, spec.final_outer_lr, iteration - warmup, spec.iterations - warmup);
}

/// The warm-up is a training of its own: supervised, with short rollouts.
TrainingSpec WarmupSpec(const TrainingSpec& spec) {
  TrainingSpec warmup = spec;
  warmup.algorithm = Algorithm::kSupervised;
  if (spec.loss.horizon == nssm::LossSpec::kWholeSet || spec.loss.horizon > spec.warmup_horizon) {
    warmup.loss.horizon = spec.warmup_horizon;
  }
  return warmup;
}

/// One phase of training: what a loss and an algorithm need to be drawn and evaluated.
template <typename T>
class Phase {
 public:
  Phase(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask, const Systems& systems,
        base::Executor* executor)
      : spec_(spec),
        systems_(systems),
        executor_(executor),
        context_shape_(*nssm::ShapeOfLoss(spec.model, spec.loss, spec.context_samples)),
        target_shape_(*nssm::ShapeOfLoss(spec.model, spec.loss, spec.target_samples)),
        meta_gradient_(model, spec, context_shape_, target_shape_, mask) {
    for (size_t slot = 0; slot < executor->concurrency(); ++slot) scratch_.emplace_back(meta_gradient_);
    gradients_.assign(static_cast<size_t>(spec.task_batch), std::vector<T>(meta_gradient_.variables()));
  }

  /// Mean loss and meta-gradient over the tasks of one outer step.
  double Gradient(int32_t iteration, const std::vector<double>& at, std::vector<double>* mean) {
    const std::vector<T> parameters(at.begin(), at.end());
    const size_t tasks = gradients_.size();
    std::vector<double> losses(tasks);
    executor_->ParallelFor(tasks, [&](size_t task, size_t slot) {
      base::Rng rng(spec_.seed, 1 + static_cast<uint64_t>(iteration) * tasks + task);
      const Trajectory& system = systems_.training[rng.Index(systems_.training.size())];
      const LossData<T> context = DrawContext(system, &rng), target = DrawTarget(system, &rng);
      losses[task] = meta_gradient_.Compute(parameters.data(), context, target, gradients_[task].data(), &scratch_[slot]);
    });
    mean->assign(parameters.size(), 0.0);
    double loss = 0;
    for (size_t task = 0; task < tasks; ++task) {
      loss += losses[task] / static_cast<double>(tasks);
      for (size_t i = 0; i < parameters.size(); ++i) {
        (*mean)[i] += static_cast<double>(gradients_[task][i]) / static_cast<double>(tasks);
      }
    }
    return loss;
  }

  /// Mean loss over the held-out systems, on the same sets every time, so that iterations compare.
  double ValidationLoss(const std::vector<double>& at) {
    const std::vector<T> parameters(at.begin(), at.end());
    std::vector<double> losses(systems_.validation.size() * kValidationDraws);
    executor_->ParallelFor(losses.size(), [&](size_t index, size_t slot) {
      base::Rng rng(~spec_.seed, index);
      const Trajectory& system = systems_.validation[index / kValidationDraws];
      const LossData<T> context = DrawContext(system, &rng), target = DrawTarget(system, &rng);
      losses[index] = meta_gradient_.TargetLoss(parameters.data(), context, target, &scratch_[slot]);
    });
    double sum = 0;
    for (const double loss : losses) sum += loss;
    return sum / static_cast<double>(losses.size());
  }

 private:
  LossData<T> Draw(const Trajectory& system, int32_t samples, const LossShape& shape, base::Rng* rng) const {
    const uint64_t places = static_cast<uint64_t>(system.length() - samples + 1);
    return nssm::CutLossData<T>(spec_.model, spec_.loss, system, static_cast<int64_t>(rng->Index(places)), shape);
  }
  LossData<T> DrawContext(const Trajectory& system, base::Rng* rng) const {
    return Draw(system, spec_.context_samples, context_shape_, rng);
  }
  LossData<T> DrawTarget(const Trajectory& system, base::Rng* rng) const {
    return Draw(system, spec_.target_samples, target_shape_, rng);
  }

  const TrainingSpec spec_;
  const Systems& systems_;
  base::Executor* executor_;
  const LossShape context_shape_, target_shape_;
  const MetaGradient<T> meta_gradient_;
  std::vector<typename MetaGradient<T>::Scratch> scratch_;
  std::vector<std::vector<T>> gradients_;
};

/// Names in TrainingState::values.
constexpr char kParameters[] = "parameters", kFirstMoment[] = "first_moment", kSecondMoment[] = "second_moment",
               kBest[] = "best_parameters", kFirstLoss[] = "first_loss";

absl::Status Diverged(const TrainingSpec& spec, int32_t iteration, double loss, double norm, const TrainingState& good) {
  std::string best;
  if (std::isfinite(good.best_validation_loss)) {
    best = absl::StrCat(" and the best so far, of validation loss ", base::FormatShort(good.best_validation_loss));
  }
  return absl::OutOfRangeError(absl::StrCat(
      "the training diverged at iteration ", iteration, ": loss ", base::FormatShort(loss), ", gradient norm ",
      base::FormatShort(norm), "; the last checkpoint holds the last good state, that after iteration ", good.iteration,
      best, "; a smaller outer_lr (now ", base::FormatShort(spec.outer_lr), "), inner_loop.learning_rate (now ",
      base::FormatShort(spec.inner_loop.learning_rate), ") or clip_norm may help"));
}

/// The best or last variables, taken apart.
LearnedStart TakeApart(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask,
                       const std::vector<double>& variables) {
  const auto rates = variables.begin() + model.layout().size();
  LearnedStart result{.parameters = std::vector<double>(variables.begin(), rates)};
  if (!spec.inner_loop.learned_rates) return result;
  auto rate = rates;
  for (size_t i = 0; i < mask.size(); ++i) {
    if (mask[i]) result.tensor_rates[model.layout().tensors()[i].name] = std::exp(*rate++);
  }
  return result;
}

/// One training, from its state on.
template <typename T>
class OuterLoop {
 public:
  OuterLoop(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask, const Systems& systems,
            base::Executor* executor, TrainingState* state)
      : spec_(spec), systems_(systems), state_(state), main_(spec, model, mask, systems, executor) {
    if (state->iteration < spec.warmup_iterations) warmup_.emplace(WarmupSpec(spec), model, mask, systems, executor);
  }

  /// Errors: those of RunOuterLoop.
  absl::Status Run(const OnTrainingStep& on_step) {
    while (state_->iteration < spec_.iterations) {
      const absl::Status stepped = Step();
      if (!stepped.ok()) {
        if (on_step) on_step({.state = *state_, .iterations = spec_.iterations, .diverged = true});
        return stepped;
      }
      const bool validate = !systems_.validation.empty() && (state_->iteration % spec_.validation_period == 0 ||
                                                             state_->iteration == spec_.iterations);
      if (validate) Validate();
      if (on_step && !on_step({*state_, spec_.iterations, validate})) {
        return absl::CancelledError("the training was cancelled");
      }
    }
    return absl::OkStatus();
  }

 private:
  absl::Status Step() {
    std::vector<double>& parameters = state_->values[kParameters];
    std::vector<double>& first_moment = state_->values[kFirstMoment];
    std::vector<double>& second_moment = state_->values[kSecondMoment];
    const bool warming_up = state_->iteration < spec_.warmup_iterations;
    if (state_->iteration == spec_.warmup_iterations) {
      // Another loss: the warm-up's squared gradients would throttle the first thousand steps on it.
      std::fill(first_moment.begin(), first_moment.end(), 0.0);
      std::fill(second_moment.begin(), second_moment.end(), 0.0);
    }
    const double loss = (warming_up ? *warmup_ : main_).Gradient(state_->iteration, parameters, &gradient_);
    const double norm = ClipNorm(spec_.clip_norm, &gradient_);
    const int32_t step = state_->iteration + 1 - (warming_up ? 0 : spec_.warmup_iterations);
    const double first_loss = step == 1 ? loss : state_->values[kFirstLoss].front();
    const double last = step == 1 ? loss : state_->training_loss;
    const double mean_loss = last + kTrainingLossWeight * (loss - last);
    if (!std::isfinite(loss) || !std::isfinite(norm) || mean_loss > kHopeless * std::max(1.0, first_loss)) {
      const int32_t iteration = state_->iteration + 1;
      if (good_) *state_ = *std::move(good_);
      return Diverged(spec_, iteration, loss, norm, *state_);
    }
    good_ = *state_;
    state_->values[kFirstLoss].front() = first_loss;
    state_->training_loss = mean_loss;
    const double rate = LearningRate(spec_, state_->iteration);
    ++state_->iteration;
    AdamStep(gradient_, step, rate, &first_moment, &second_moment, &parameters);
    nssm::RoundToPrecision(spec_.model.precision, &parameters);
    return absl::OkStatus();
  }

  void Validate() {
    const std::vector<double>& parameters = state_->values[kParameters];
    state_->validation_loss = main_.ValidationLoss(parameters);
    if (!(state_->validation_loss < state_->best_validation_loss)) return;
    state_->best_validation_loss = state_->validation_loss;
    state_->values[kBest] = parameters;
  }

  const TrainingSpec& spec_;
  const Systems& systems_;
  TrainingState* state_;
  std::optional<TrainingState> good_;  // at the newest loss and gradient that were numbers
  Phase<T> main_;
  std::optional<Phase<T>> warmup_;
  std::vector<double> gradient_;
};

/// A state to begin with, or to go on from if it has what the loop needs.
absl::Status Prepare(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask, TrainingState* state) {
  std::vector<double> parameters = model.InitialParameters(spec.seed);
  if (spec.inner_loop.learned_rates) {
    const std::vector<double> rates = RatesOfTensors(spec.inner_loop, model.layout());
    for (size_t i = 0; i < mask.size(); ++i) {
      if (mask[i]) parameters.push_back(std::log(rates[i]));
    }
  }
  nssm::RoundToPrecision(spec.model.precision, &parameters);
  const std::vector<double> zeros(parameters.size());
  const std::map<std::string, std::vector<double>> fresh = {{kParameters, parameters}, {kFirstMoment, zeros},
                                                            {kSecondMoment, zeros},    {kBest, parameters},
                                                            {kFirstLoss, {0}}};
  if (state->values.empty()) {
    state->values = fresh;
    state->best_validation_loss = state->validation_loss = std::numeric_limits<double>::infinity();
  }
  for (const auto& [name, values] : fresh) {
    if (state->values[name].size() != values.size()) {
      return absl::InvalidArgumentError(absl::StrCat("the checkpoint's \"", name, "\" is not the model's"));
    }
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<LearnedStart> RunOuterLoop(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask,
                                          const Systems& systems, base::Executor* executor, TrainingState* state,
                                          const OnTrainingStep& on_step) {
  METAEKF_RETURN_IF_ERROR(Prepare(spec, model, mask, state));
  METAEKF_RETURN_IF_ERROR(spec.model.precision == nssm::Precision::kFloat32
                              ? OuterLoop<float>(spec, model, mask, systems, executor, state).Run(on_step)
                              : OuterLoop<double>(spec, model, mask, systems, executor, state).Run(on_step));
  return TakeApart(spec, model, mask, state->values[systems.validation.empty() ? kParameters : kBest]);
}

}  // namespace metaekf::meta
