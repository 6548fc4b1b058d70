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
        meta_gradient_(model, spec.loss, spec.algorithm, context_shape_, target_shape_, mask, spec.inner_loop.steps,
                       spec.inner_loop.learning_rate) {
    for (size_t slot = 0; slot < executor->concurrency(); ++slot) scratch_.emplace_back(meta_gradient_);
    gradients_.assign(static_cast<size_t>(spec.task_batch), std::vector<T>(static_cast<size_t>(model.layout().size())));
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

absl::Status Diverged(int32_t iteration, double loss, double norm) {
  return absl::OutOfRangeError(
      absl::StrCat("the training diverged at iteration ", iteration, ": loss ", base::FormatShort(loss), ", gradient norm ",
                   base::FormatShort(norm), "; a smaller inner_loop.learning_rate or outer_lr may help"));
}

template <typename T>
absl::StatusOr<std::vector<double>> Run(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask,
                          const Systems& systems, base::Executor* executor, TrainingState* state,
                          const OnTrainingStep& on_step) {
  Phase<T> main(spec, model, mask, systems, executor);
  std::optional<Phase<T>> warmup;
  if (state->iteration < spec.warmup_iterations) warmup.emplace(WarmupSpec(spec), model, mask, systems, executor);
  std::vector<double>& parameters = state->values["parameters"];
  std::vector<double>& first_moment = state->values["first_moment"];
  std::vector<double>& second_moment = state->values["second_moment"];
  std::vector<double>& best = state->values["best_parameters"];
  std::vector<double> gradient;
  while (state->iteration < spec.iterations) {
    const bool warming_up = state->iteration < spec.warmup_iterations;
    if (state->iteration == spec.warmup_iterations) {
      // Another loss: the warm-up's squared gradients would throttle the first thousand steps on it.
      std::fill(first_moment.begin(), first_moment.end(), 0.0);
      std::fill(second_moment.begin(), second_moment.end(), 0.0);
    }
    const double loss = (warming_up ? *warmup : main).Gradient(state->iteration, parameters, &gradient);
    const double norm = ClipNorm(spec.clip_norm, &gradient);
    if (!std::isfinite(loss) || !std::isfinite(norm)) return Diverged(state->iteration + 1, loss, norm);
    const double rate = LearningRate(spec, state->iteration);
    ++state->iteration;
    const int32_t step = warming_up ? state->iteration : state->iteration - spec.warmup_iterations;
    AdamStep(gradient, step, rate, &first_moment, &second_moment, &parameters);
    nssm::RoundToPrecision(spec.model.precision, &parameters);
    state->training_loss = step == 1 ? loss : state->training_loss + kTrainingLossWeight * (loss - state->training_loss);
    const bool validate = !systems.validation.empty() && (state->iteration % spec.validation_period == 0 ||
                                                          state->iteration == spec.iterations);
    if (validate) {
      state->validation_loss = main.ValidationLoss(parameters);
      if (state->validation_loss < state->best_validation_loss) {
        state->best_validation_loss = state->validation_loss;
        best = parameters;
      }
    }
    if (on_step && !on_step({*state, spec.iterations, validate})) return absl::CancelledError("the training was cancelled");
  }
  return systems.validation.empty() ? parameters : best;
}

/// A state to begin with, or to go on from if it has what the loop needs.
absl::Status Prepare(const TrainingSpec& spec, const nssm::Model& model, TrainingState* state) {
  const size_t size = static_cast<size_t>(model.layout().size());
  if (state->values.empty()) {
    std::vector<double> parameters = model.InitialParameters(spec.seed);
    nssm::RoundToPrecision(spec.model.precision, &parameters);
    state->values = {{"parameters", parameters},
                     {"first_moment", std::vector<double>(size)},
                     {"second_moment", std::vector<double>(size)},
                     {"best_parameters", parameters}};
    state->best_validation_loss = state->validation_loss = std::numeric_limits<double>::infinity();
  }
  for (const char* name : {"parameters", "first_moment", "second_moment", "best_parameters"}) {
    if (state->values[name].size() != size) {
      return absl::InvalidArgumentError(absl::StrCat("the checkpoint's \"", name, "\" is not the model's"));
    }
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<std::vector<double>> RunOuterLoop(const TrainingSpec& spec, const nssm::Model& model,
                                                 const nn::Mask& mask, const Systems& systems, base::Executor* executor,
                                                 TrainingState* state, const OnTrainingStep& on_step) {
  METAEKF_RETURN_IF_ERROR(Prepare(spec, model, state));
  return spec.model.precision == nssm::Precision::kFloat32
             ? Run<float>(spec, model, mask, systems, executor, state, on_step)
             : Run<double>(spec, model, mask, systems, executor, state, on_step);
}

}  // namespace metaekf::meta
