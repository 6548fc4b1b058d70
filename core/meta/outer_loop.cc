#include "core/meta/outer_loop.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include "core/base/numbers.h"
#include "core/base/rng.h"
#include "core/base/status.h"
#include "core/meta/adam.h"
#include "core/meta/linear_state_start.h"
#include "core/meta/meta_gradient.h"
#include "core/meta/training_schedule.h"

namespace metaekf::meta {
namespace {

using data::Trajectory;
using nssm::LossData;
using nssm::LossShape;

constexpr int kValidationDraws = 2;          // context and target sets per held-out system
constexpr int kCurvatureSystems = 16;
constexpr double kTrainingLossWeight = 0.1;  // of the newest step in the running mean
constexpr double kHopeless = 1e6;            // times the first loss: from there no training comes back

/// Of MIXED_EFFECTS: where each training system's own δ are among the variables, and which of ω they are added to.
class OwnEffects {
 public:
  /// @param first  variables before the δ.
  OwnEffects(const nssm::Model& model, const nn::Mask& mask, size_t first) : first_(first) {
    for (size_t i = 0; i < mask.size(); ++i) {
      const nn::Tensor& tensor = model.layout().tensors()[i];
      for (int64_t k = 0; mask[i] && k < tensor.size(); ++k) entries_.push_back(static_cast<size_t>(tensor.offset + k));
    }
  }
  size_t size() const { return entries_.size(); }
  size_t entry(size_t k) const { return entries_[k]; }
  size_t variable(size_t system, size_t k) const { return first_ + system * entries_.size() + k; }

 private:
  size_t first_;
  std::vector<size_t> entries_;
};

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
        meta_gradient_(model, spec, context_shape_, target_shape_, mask),
        own_(model, mask, meta_gradient_.variables()),
        of_systems_(executor->concurrency()) {
    for (size_t slot = 0; slot < executor->concurrency(); ++slot) scratch_.emplace_back(meta_gradient_);
    gradients_.assign(static_cast<size_t>(spec.task_batch), std::vector<T>(meta_gradient_.variables()));
  }

  /// Mean loss and meta-gradient over the tasks of one outer step.
  double Gradient(int32_t iteration, const std::vector<double>& at, std::vector<double>* mean) {
    const std::vector<T> parameters(at.begin(), at.end());
    const size_t tasks = gradients_.size();
    const bool mixed = spec_.algorithm == Algorithm::kMixedEffects;
    std::vector<double> losses(tasks);
    std::vector<size_t> drawn(tasks);
    executor_->ParallelFor(tasks, [&](size_t task, size_t slot) {
      base::Rng rng(spec_.seed, 1 + static_cast<uint64_t>(iteration) * tasks + task);
      drawn[task] = rng.Index(systems_.training.size());
      const Trajectory& system = systems_.training[drawn[task]];
      const LossData<T> context = DrawContext(system, &rng), target = DrawTarget(system, &rng);
      const T* variables = mixed ? OfSystem(drawn[task], parameters, &of_systems_[slot]) : parameters.data();
      losses[task] = meta_gradient_.Compute(variables, context, target, gradients_[task].data(), &scratch_[slot]);
    });
    mean->assign(parameters.size(), 0.0);
    const double share = 1 / static_cast<double>(tasks);
    double loss = 0;
    for (size_t task = 0; task < tasks; ++task) {
      loss += share * losses[task];
      for (size_t i = 0; i < gradients_[task].size(); ++i) (*mean)[i] += share * static_cast<double>(gradients_[task][i]);
      for (size_t k = 0; mixed && k < own_.size(); ++k) {
        const size_t own = own_.variable(drawn[task], k);
        (*mean)[own] += share * (static_cast<double>(gradients_[task][own_.entry(k)]) + spec_.inner_loop.proximal * at[own]);
      }
    }
    return loss;
  }

  /// Of every adapted tensor the largest curvature of the context loss that any of kCurvatureSystems systems has; that of the
  /// steepest tensor where there is none. Errors: OutOfRange if one is a number for no system.
  absl::StatusOr<std::vector<double>> Curvatures(const std::vector<double>& at) {
    const std::vector<T> parameters(at.begin(), at.end());
    std::vector<std::vector<double>> of_systems(kCurvatureSystems);
    executor_->ParallelFor(of_systems.size(), [&](size_t index, size_t slot) {
      base::Rng rng(~spec_.seed, (uint64_t{1} << 32) + index);
      const Trajectory& system = systems_.training[rng.Index(systems_.training.size())];
      of_systems[index] = meta_gradient_.Curvatures(parameters.data(), DrawContext(system, &rng), &scratch_[slot]);
    });
    constexpr double kNone = -1;
    std::vector<double> largest(of_systems.front().size(), kNone);
    for (const std::vector<double>& own : of_systems) {
      for (size_t l = 0; l < largest.size(); ++l) {
        if (std::isfinite(own[l])) largest[l] = std::max(largest[l], std::max(own[l], 0.0));
      }
    }
    if (std::find(largest.begin(), largest.end(), kNone) != largest.end()) {
      return absl::OutOfRangeError("inner_loop.curvature_rates: the loss after the warm-up has no finite curvature; a smaller "
                                   "warmup_lr or a shorter horizon may help");
    }
    const double steepest = *std::max_element(largest.begin(), largest.end());
    for (double& curvature : largest) {
      if (curvature == 0) curvature = steepest;
    }
    return largest;
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
  /// ω + δ of a system.
  const T* OfSystem(size_t system, const std::vector<T>& variables, std::vector<T>* own) const {
    own->assign(variables.begin(), variables.begin() + static_cast<std::ptrdiff_t>(meta_gradient_.variables()));
    for (size_t k = 0; k < own_.size(); ++k) (*own)[own_.entry(k)] += variables[own_.variable(system, k)];
    return own->data();
  }
  LossData<T> Draw(const Trajectory& system, int32_t samples, const LossShape& shape, base::Rng* rng) const {
    const uint64_t places = static_cast<uint64_t>(system.length() - samples + 1);
    return nssm::CutLossData<T>(spec_.model, spec_.loss, system, static_cast<int64_t>(rng->Index(places)), shape);
  }
  LossData<T> DrawContext(const Trajectory& system, base::Rng* rng) const {
    if (spec_.contexts_at_start) return nssm::CutLossData<T>(spec_.model, spec_.loss, system, 0, context_shape_);
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
  const OwnEffects own_;
  std::vector<std::vector<T>> of_systems_;  // ω + δ, one per thread
  std::vector<typename MetaGradient<T>::Scratch> scratch_;
  std::vector<std::vector<T>> gradients_;
};

/// Names in TrainingState::values.
constexpr char kParameters[] = "parameters", kFirstMoment[] = "first_moment", kSecondMoment[] = "second_moment",
               kBest[] = "best_parameters", kFirstLoss[] = "first_loss";
/// While starts are screened: the values of the best that has been, under their names behind this prefix, and its losses.
constexpr char kScreened[] = "screened_", kScreenedLosses[] = "screened_losses";

/// How the steps of the screening and of the training follow each other: start 0, start 1, …, the rest of the best one.
class Schedule {
 public:
  explicit Schedule(const TrainingSpec& spec)
      : restarts_(spec.restarts), screening_(spec.restarts > 1 ? spec.screening_iterations : 0), iterations_(spec.iterations) {}

  int32_t steps() const { return iterations_ + (restarts_ - 1) * screening_; }
  bool screens(int32_t step) const { return step < restarts_ * screening_; }
  /// Whether a start has come to the end of its screening after so many steps.
  bool ends_start(int32_t steps) const { return steps > 0 && screens(steps - 1) && steps % screening_ == 0; }
  /// Of the start that a step of the screening is in.
  int32_t start(int32_t step) const { return step / screening_; }
  int32_t first_step(int32_t start) const { return start * screening_; }
  /// Iteration of the training that a step is: each start goes through the same ones.
  int32_t iteration(int32_t step) const { return screens(step) ? step % screening_ : step - (restarts_ - 1) * screening_; }
  int32_t restarts() const { return restarts_; }

 private:
  int32_t restarts_, screening_, iterations_;
};

/// Variables of a start and all that the outer loop keeps beside them.
std::map<std::string, std::vector<double>> FreshValues(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask,
                                                       const Systems& systems, int32_t start) {
  const uint64_t seed = spec.seed ^ (static_cast<uint64_t>(start) << 32);
  std::vector<double> variables = spec.linear_start ? *LinearStateStart(model, systems.training, seed) : model.InitialParameters(seed);
  if (spec.inner_loop.learned_rates) {
    const std::vector<double> rates = RatesOfTensors(spec.inner_loop, model.layout());
    for (size_t i = 0; i < mask.size(); ++i) {
      if (mask[i]) variables.push_back(std::log(rates[i]));
    }
  }
  if (spec.algorithm == Algorithm::kMixedEffects) {
    variables.resize(variables.size() + systems.training.size() * OwnEffects(model, mask, 0).size(), 0.0);
  }
  nssm::RoundToPrecision(spec.model.precision, &variables);
  const std::vector<double> zeros(variables.size());
  return {{kParameters, variables}, {kFirstMoment, zeros}, {kSecondMoment, zeros}, {kBest, variables}, {kFirstLoss, {0}}};
}

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
LearnedStart TakeApart(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask, size_t systems,
                       const std::vector<double>& variables) {
  const auto rates = variables.begin() + model.layout().size();
  LearnedStart result{.parameters = std::vector<double>(variables.begin(), rates)};
  if (spec.algorithm == Algorithm::kMixedEffects) {
    const OwnEffects own(model, mask, result.parameters.size());
    result.own.resize(static_cast<Eigen::Index>(own.size()), static_cast<Eigen::Index>(systems));
    for (size_t k = 0; k < own.size(); ++k) {
      const auto row = static_cast<Eigen::Index>(k);
      for (size_t s = 0; s < systems; ++s) {
        result.own(row, static_cast<Eigen::Index>(s)) = result.parameters[own.entry(k)] + variables[own.variable(s, k)];
      }
      result.parameters[own.entry(k)] = result.own.row(row).mean();
    }
    nssm::RoundToPrecision(spec.model.precision, &result.parameters);
  }
  if (!spec.inner_loop.learned_rates) return result;
  auto rate = rates;
  for (size_t i = 0; i < mask.size(); ++i) {
    if (mask[i]) {
      result.tensor_rates[model.layout().tensors()[i].name] = std::clamp(std::exp(*rate++), kSmallestRate, kLargestRate);
    }
  }
  return result;
}

nn::Mask FrozenTensors(const TrainingSpec& spec, const nssm::Model& model) {
  return spec.frozen_mask.empty() ? nn::Mask(model.layout().tensors().size(), false) : *nn::ParseMask(spec.frozen_mask, model.layout());
}

/// One training, from its state on.
template <typename T>
class OuterLoop {
 public:
  OuterLoop(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask, const Systems& systems,
            base::Executor* executor, TrainingState* state)
      : spec_(spec),
        model_(model),
        mask_(mask),
        frozen_(FrozenTensors(spec, model)),
        systems_(systems),
        state_(state),
        schedule_(spec),
        executor_(executor),
        main_(spec, model, mask, systems, executor) {}

  /// Errors: those of RunOuterLoop.
  absl::Status Run(const OnTrainingStep& on_step) {
    while (true) {
      const int32_t step = state_->iteration, iteration = schedule_.iteration(step);
      // Not before: a checkpoint of this step is that of the start which has just ended.
      if (schedule_.ends_start(step)) EndStart(schedule_.start(step - 1));
      if (step == schedule_.steps()) return absl::OkStatus();
      const bool screens = schedule_.screens(step);
      const absl::Status stepped = Step(iteration);
      if (!stepped.ok() && !(screens && DropStart(step))) {
        if (on_step) on_step({.state = *state_, .iterations = schedule_.steps(), .diverged = true});
        return stepped;
      }
      // Rates that stand for multiples still adapt nothing.
      const bool judgeable = spec_.algorithm != Algorithm::kMixedEffects && (!spec_.inner_loop.curvature_rates || iteration >= spec_.warmup_iterations);
      const bool validate = stepped.ok() && judgeable && !systems_.validation.empty() &&
                            ((iteration + 1) % spec_.validation_period == 0 || iteration + 1 == spec_.iterations ||
                             schedule_.ends_start(state_->iteration));
      if (validate) Validate();
      if (on_step && !on_step({*state_, schedule_.steps(), validate})) {
        return absl::CancelledError("the training was cancelled");
      }
    }
  }

 private:
  // ---- screening ----

  /// A start that has diverged ends early, unless it is the last hope. @return whether another goes on.
  bool DropStart(int32_t step) {
    const int32_t start = schedule_.start(step);
    if (start + 1 == schedule_.restarts() && !state_->values.contains(kScreenedLosses)) return false;
    state_->iteration = schedule_.first_step(start + 1);
    state_->validation_loss = std::numeric_limits<double>::infinity();
    return true;
  }

  /// Puts the start that has been screened beside the best so far, and begins the next or goes on with the best.
  void EndStart(int32_t start) {
    auto& values = state_->values;
    std::map<std::string, std::vector<double>> own, best;
    for (const auto& [name, numbers] : values) {
      if (name.starts_with(kScreened)) {
        best[name] = numbers;
      } else {
        own[name] = numbers;
      }
    }
    const bool last = start + 1 == schedule_.restarts();
    if (best.empty() ? last || std::isfinite(state_->validation_loss) : state_->validation_loss < best[kScreenedLosses][0]) {
      best.clear();
      for (const auto& [name, numbers] : own) best[kScreened + name] = numbers;
      best[kScreenedLosses] = {state_->validation_loss, state_->best_validation_loss, state_->training_loss};
    }
    good_.reset();
    if (!last) {
      state_->best_validation_loss = state_->validation_loss = std::numeric_limits<double>::infinity();
      values = FreshValues(spec_, model_, mask_, systems_, start + 1);
      values.merge(best);
      return;
    }
    state_->validation_loss = best[kScreenedLosses][0];
    state_->best_validation_loss = best[kScreenedLosses][1];
    state_->training_loss = best[kScreenedLosses][2];
    for (auto& [name, numbers] : own) numbers = best[kScreened + name];
    values = std::move(own);
  }

  // ---- steps ----

  /// The phase that an iteration is in; one before the main one is kept until another is asked for.
  Phase<T>& PhaseOf(int32_t iteration) {
    const TrainingSpec own = SpecOf(spec_, iteration);
    if (own.algorithm == spec_.algorithm && own.loss.horizon == spec_.loss.horizon) return main_;
    if (!early_ || early_spec_.algorithm != own.algorithm || early_spec_.loss.horizon != own.loss.horizon) {
      early_spec_ = own;
      early_.emplace(own, model_, mask_, systems_, executor_);
    }
    return *early_;
  }

  /// @param iteration  of the training, from 0 on, that this step is.
  absl::Status Step(int32_t iteration) {
    std::vector<double>& parameters = state_->values[kParameters];
    std::vector<double>& first_moment = state_->values[kFirstMoment];
    std::vector<double>& second_moment = state_->values[kSecondMoment];
    const bool warming_up = iteration < spec_.warmup_iterations;
    Phase<T>& phase = PhaseOf(iteration);
    if (iteration == spec_.warmup_iterations) {
      // Another loss: the warm-up's squared gradients would throttle the first thousand steps on it.
      std::fill(first_moment.begin(), first_moment.end(), 0.0);
      std::fill(second_moment.begin(), second_moment.end(), 0.0);
      if (spec_.inner_loop.curvature_rates) {
        METAEKF_ASSIGN_OR_RETURN(const std::vector<double> curvatures, main_.Curvatures(parameters));
        ScaleRates(curvatures, &parameters);
      }
    }
    const double loss = phase.Gradient(iteration, parameters, &gradient_);
    for (size_t i = 0; i < frozen_.size(); ++i) {
      const nn::Tensor& tensor = model_.layout().tensors()[i];
      if (frozen_[i]) std::fill_n(gradient_.begin() + tensor.offset, tensor.size(), 0.0);
    }
    const double norm = ClipNorm(spec_.clip_norm, &gradient_);
    const int32_t step = iteration + 1 - (warming_up ? 0 : spec_.warmup_iterations);
    const double first_loss = step == 1 ? loss : state_->values[kFirstLoss].front();
    const double last = step == 1 ? loss : state_->training_loss;
    const double mean_loss = last + kTrainingLossWeight * (loss - last);
    if (!std::isfinite(loss) || !std::isfinite(norm) || mean_loss > kHopeless * std::max(1.0, first_loss)) {
      if (good_) *state_ = *std::move(good_);
      return Diverged(spec_, iteration + 1, loss, norm, *state_);
    }
    good_ = *state_;
    state_->values[kFirstLoss].front() = first_loss;
    state_->training_loss = mean_loss;
    const double rate = LearningRate(spec_, iteration);
    ++state_->iteration;
    AdamStep(gradient_, step, rate, &first_moment, &second_moment, &parameters);
    nssm::RoundToPrecision(spec_.model.precision, &parameters);
    return absl::OkStatus();
  }

  /// Rates that have stood for multiples of 1/(L λ) become those: the loss is that of the main phase from here on. With L
  /// tensors of curvatures λ_l the Hessian is at most L diag(λ_l I): a Hessian without negative curvature is a Gram matrix of
  /// L blocks, |Σ_l J_l d_l|² ≤ L Σ_l λ_l |d_l|².
  void ScaleRates(const std::vector<double>& curvatures, std::vector<double>* variables) const {
    const size_t first = variables->size() - curvatures.size();
    for (size_t l = 0; l < curvatures.size(); ++l) {
      if (curvatures[l] > 0) (*variables)[first + l] -= std::log(static_cast<double>(curvatures.size()) * curvatures[l]);
    }
    nssm::RoundToPrecision(spec_.model.precision, variables);
  }

  void Validate() {
    const std::vector<double>& parameters = state_->values[kParameters];
    state_->validation_loss = main_.ValidationLoss(parameters);
    if (!(state_->validation_loss < state_->best_validation_loss)) return;
    state_->best_validation_loss = state_->validation_loss;
    state_->values[kBest] = parameters;
  }

  const TrainingSpec& spec_;
  const nssm::Model& model_;
  const nn::Mask& mask_;
  const nn::Mask frozen_;
  const Systems& systems_;
  TrainingState* state_;
  const Schedule schedule_;
  std::optional<TrainingState> good_;  // at the newest loss and gradient that were numbers
  base::Executor* executor_;
  Phase<T> main_;
  std::optional<Phase<T>> early_;  // of the warm-up, or of rollouts that grow
  TrainingSpec early_spec_;
  std::vector<double> gradient_;
};

/// A state to begin with, or to go on from if it has what the loop needs.
absl::Status Prepare(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask, const Systems& systems, TrainingState* state) {
  if (spec.linear_start) METAEKF_RETURN_IF_ERROR(base::Annotate(CheckLinearStateStart(model.spec()), "linear_start"));
  const std::map<std::string, std::vector<double>> fresh = FreshValues(spec, model, mask, systems, 0);
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
  if (spec.restarts > 1 && systems.validation.empty()) {
    return absl::InvalidArgumentError(
        "restarts: there is no system to choose among starts by; a larger validation_share holds some out");
  }
  METAEKF_RETURN_IF_ERROR(base::Annotate(nn::ParseMask(spec.frozen_mask, model.layout()).status(), "frozen_mask"));
  METAEKF_RETURN_IF_ERROR(Prepare(spec, model, mask, systems, state));
  METAEKF_RETURN_IF_ERROR(spec.model.precision == nssm::Precision::kFloat32
                              ? OuterLoop<float>(spec, model, mask, systems, executor, state).Run(on_step)
                              : OuterLoop<double>(spec, model, mask, systems, executor, state).Run(on_step));
  const bool judged = !systems.validation.empty() && spec.algorithm != Algorithm::kMixedEffects;
  return TakeApart(spec, model, mask, systems.training.size(), state->values[judged ? kBest : kParameters]);
}

}  // namespace metaekf::meta
