#include "core/meta/train.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <optional>

#include "core/base/numbers.h"
#include "core/base/rng.h"
#include "core/base/status.h"
#include "core/data/split.h"
#include "core/filter/noise.h"
#include "core/meta/adam.h"
#include "core/meta/adapt.h"
#include "core/meta/meta_gradient.h"
#include "core/nssm/safetensors.h"

namespace metaekf::meta {
namespace {

using data::Dataset;
using data::Trajectory;
using nssm::Bundle;
using nssm::LossData;
using nssm::LossShape;
using nssm::ModelSpec;

using OnStep = std::function<bool(const TrainingProgress&)>;

constexpr int kValidationDraws = 2;       // context and target sets per held-out system
constexpr size_t kNoiseSystems = 8;    // systems whose residuals give the default covariances, at most
constexpr double kTrainingLossWeight = 0.1;  // of the newest step in the running mean

/// Takes what the spec leaves open from the data, and refuses data that does not fit it.
absl::Status FitSpecToData(const Dataset& fleet, TrainingSpec* spec) {
  ModelSpec& model = spec->model;
  const auto fit = [](const std::string& signal, const std::vector<std::string>& names, int32_t* size) {
    const int32_t given = static_cast<int32_t>(names.size());
    if (*size == ModelSpec::kFromData) *size = given;
    if (*size == given) return absl::OkStatus();
    return absl::InvalidArgumentError(absl::StrCat("model.", signal, "_size is ", *size, ", the data has ", given));
  };
  METAEKF_RETURN_IF_ERROR(fit("input", fleet.input_names, &model.input_size));
  METAEKF_RETURN_IF_ERROR(fit("output", fleet.output_names, &model.output_size));
  if (!model.is_case_one()) METAEKF_RETURN_IF_ERROR(fit("state", fleet.state_names, &model.state_size));
  if (model.output_size == 0) return absl::InvalidArgumentError("the data has no output columns (y1, y2, …)");
  if (!model.is_case_one() && model.state_size == 0) {
    return absl::InvalidArgumentError("the model is Case II (STATE_INPUT_OUTPUT) but the data has no state columns (x1, x2, …)");
  }
  if (fleet.trajectories.empty()) return absl::InvalidArgumentError("the data has no trajectory");
  for (const Trajectory& trajectory : fleet.trajectories) {
    if (spec->sample_period_s == 0) spec->sample_period_s = trajectory.sample_period_s;
    const double period = trajectory.sample_period_s;
    if (period != 0 && std::fabs(period - spec->sample_period_s) > 1e-6 * spec->sample_period_s) {
      return absl::InvalidArgumentError(absl::StrCat("trajectory ", trajectory.name, ": its sample period is ",
                                                     base::FormatShort(period), " s, that of the others ",
                                                     base::FormatShort(spec->sample_period_s), " s"));
    }
    const int64_t needed = std::max(spec->context_samples, spec->target_samples);
    if (trajectory.length() < needed) {
      return absl::FailedPreconditionError(absl::StrCat("trajectory ", trajectory.name, ": ", trajectory.length(),
                                                        " samples, context and target sets need ", needed));
    }
  }
  if (spec->sample_period_s == 0) {
    return absl::InvalidArgumentError("the sample period is unknown: neither the data has times nor the spec sample_period_s");
  }
  // The spec is read again whole, for what it says about curl-free outputs depends on the sizes.
  return nssm::ReadModelSpec(base::JsonFields(nssm::ToJson(model), "model")).status();
}

/// A field stays free of curl through the normalisation only if its components share a scale, and so do the positions.
std::vector<data::ScaleGroup> ScaleGroups(const ModelSpec& model) {
  if (!model.is_curl_free()) return {};
  data::ScaleGroup group;
  for (int32_t i = 0; i < model.output_size; ++i) group.outputs.push_back(i);
  group.states.assign(model.curl_free_positions.begin(), model.curl_free_positions.end());
  return {group};
}

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

/// Systems in normalised units.
struct Systems {
  std::vector<Trajectory> training, validation;
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
        meta_gradient_(model, spec.loss, spec.algorithm, context_shape_, target_shape_, mask, spec.inner_loop.steps,
                       spec.inner_loop.learning_rate) {
    for (size_t slot = 0; slot < executor->concurrency(); ++slot) scratch_.emplace_back(meta_gradient_);
    gradients_.assign(static_cast<size_t>(spec.task_batch), std::vector<T>(static_cast<size_t>(model.layout().size())));
  }

  /// Mean loss and meta-gradient over the tasks of one outer step.
  double Gradient(const TrainingState& state, std::vector<double>* mean) {
    const std::vector<T> parameters(state.parameters.begin(), state.parameters.end());
    const size_t tasks = gradients_.size();
    std::vector<double> losses(tasks);
    executor_->ParallelFor(tasks, [&](size_t task, size_t slot) {
      base::Rng rng(spec_.seed, 1 + static_cast<uint64_t>(state.iteration) * tasks + task);
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
  double ValidationLoss(const TrainingState& state) {
    const std::vector<T> parameters(state.parameters.begin(), state.parameters.end());
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
absl::Status RunOuterLoop(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask,
                          const Systems& systems, base::Executor* executor, TrainingState* state,
                          const OnStep& on_step) {
  Phase<T> main(spec, model, mask, systems, executor);
  std::optional<Phase<T>> warmup;
  if (state->iteration < spec.warmup_iterations) warmup.emplace(WarmupSpec(spec), model, mask, systems, executor);
  std::vector<double> gradient;
  while (state->iteration < spec.iterations) {
    const bool warming_up = state->iteration < spec.warmup_iterations;
    if (state->iteration == spec.warmup_iterations) {
      // Another loss: the warm-up's squared gradients would throttle the first thousand steps on it.
      std::fill(state->first_moment.begin(), state->first_moment.end(), 0.0);
      std::fill(state->second_moment.begin(), state->second_moment.end(), 0.0);
    }
    const double loss = (warming_up ? *warmup : main).Gradient(*state, &gradient);
    const double norm = ClipNorm(spec.clip_norm, &gradient);
    if (!std::isfinite(loss) || !std::isfinite(norm)) return Diverged(state->iteration + 1, loss, norm);
    const double rate = LearningRate(spec, state->iteration);
    ++state->iteration;
    const int32_t step = warming_up ? state->iteration : state->iteration - spec.warmup_iterations;
    AdamStep(gradient, step, rate, &state->first_moment, &state->second_moment, &state->parameters);
    nssm::RoundToPrecision(spec.model.precision, &state->parameters);
    state->training_loss = step == 1 ? loss : state->training_loss + kTrainingLossWeight * (loss - state->training_loss);
    const bool validate = !systems.validation.empty() && (state->iteration % spec.validation_period == 0 ||
                                                          state->iteration == spec.iterations);
    if (validate) {
      state->validation_loss = main.ValidationLoss(*state);
      if (state->validation_loss < state->best_validation_loss) {
        state->best_validation_loss = state->validation_loss;
        state->best_parameters = state->parameters;
      }
    }
    if (on_step && !on_step({*state, spec.iterations, validate})) return absl::CancelledError("the training was cancelled");
  }
  return absl::OkStatus();
}

TrainingState InitialState(const nssm::Model& model, uint64_t seed) {
  TrainingState state;
  state.parameters = model.InitialParameters(seed);
  nssm::RoundToPrecision(model.spec().precision, &state.parameters);
  state.first_moment.assign(state.parameters.size(), 0);
  state.second_moment.assign(state.parameters.size(), 0);
  state.best_parameters = state.parameters;
  state.best_validation_loss = state.validation_loss = std::numeric_limits<double>::infinity();
  return state;
}

/// Default Q, R and P₀ from the residuals of the model adapted to each of `systems`.
absl::StatusOr<nssm::FilterNoise> NoiseOfAdaptedModels(const Bundle& bundle, const TrainingSpec& spec,
                                                       const std::vector<Trajectory>& systems, base::Executor* executor) {
  METAEKF_ASSIGN_OR_RETURN(const AdaptationOptions options, DefaultAdaptation(bundle));
  const int64_t wanted = std::max<int64_t>(spec.context_samples, ContextSamplesNeeded(spec.model, spec.loss));
  std::vector<std::vector<double>> parameters(systems.size());
  executor->ParallelFor(systems.size(), [&](size_t i, size_t) {
    const absl::StatusOr<Trajectory> context = data::FirstSamples(systems[i], std::min<int64_t>(systems[i].length(), wanted));
    absl::StatusOr<std::vector<double>> adapted = AdaptedParameters(bundle, *context, options);
    // An adaptation that diverges says nothing about noise; the unadapted model stands in.
    parameters[i] = adapted.ok() ? *std::move(adapted) : bundle.parameters;
  });
  filter::NoiseEstimate noise(bundle.model);
  for (size_t i = 0; i < systems.size(); ++i) {
    METAEKF_ASSIGN_OR_RETURN(const Trajectory normalised, data::Normalised(bundle.normaliser, systems[i]));
    noise.Add(parameters[i], normalised);
  }
  return noise.Result(bundle.normaliser);
}

std::vector<Trajectory> Pick(const std::vector<Trajectory>& from, const std::vector<size_t>& indices) {
  std::vector<Trajectory> picked;
  for (const size_t i : indices) picked.push_back(from[i]);
  return picked;
}

}  // namespace

absl::StatusOr<Bundle> Train(const TrainingSpec& given_spec, const Dataset& fleet, const TrainingState* resume,
                             base::Executor* executor, const OnStep& on_step) {
  TrainingSpec spec = given_spec;
  METAEKF_RETURN_IF_ERROR(FitSpecToData(fleet, &spec));
  METAEKF_RETURN_IF_ERROR(
      base::Annotate(nssm::ShapeOfLoss(spec.model, spec.loss, spec.context_samples).status(), "context_samples"));
  METAEKF_RETURN_IF_ERROR(
      base::Annotate(nssm::ShapeOfLoss(spec.model, spec.loss, spec.target_samples).status(), "target_samples"));
  METAEKF_ASSIGN_OR_RETURN(nssm::Model model, nssm::Model::Create(spec.model));
  METAEKF_ASSIGN_OR_RETURN(const nn::Mask mask, nn::ParseMask(spec.inner_loop.adapted_mask, model.layout()));
  METAEKF_RETURN_IF_ERROR(nn::ParseMask(spec.adaptation.adapted_mask, model.layout()).status());
  METAEKF_ASSIGN_OR_RETURN(const data::Split split,
                           data::SplitSystems(fleet.trajectories.size(), spec.validation_share, spec.seed));

  Dataset used = fleet;
  if (spec.model.is_case_one()) {
    used.state_names.clear();
    for (Trajectory& trajectory : used.trajectories) trajectory.states.resize(0, trajectory.length());
  }
  METAEKF_ASSIGN_OR_RETURN(const Dataset training_set, data::Subset(used, split.training));
  METAEKF_ASSIGN_OR_RETURN(const data::Normaliser normaliser, data::FitNormaliser(training_set, ScaleGroups(spec.model)));
  std::vector<Trajectory> normalised;
  for (const Trajectory& trajectory : used.trajectories) {
    METAEKF_ASSIGN_OR_RETURN(Trajectory n, data::Normalised(normaliser, trajectory));
    normalised.push_back(std::move(n));
  }

  TrainingState state = resume != nullptr ? *resume : InitialState(model, spec.seed);
  const Systems systems{Pick(normalised, split.training), Pick(normalised, split.validation)};
  METAEKF_RETURN_IF_ERROR(
      spec.model.precision == nssm::Precision::kFloat32
          ? RunOuterLoop<float>(spec, model, mask, systems, executor, &state, on_step)
          : RunOuterLoop<double>(spec, model, mask, systems, executor, &state, on_step));

  Bundle bundle{.model = std::move(model)};
  bundle.parameters = systems.validation.empty() ? state.parameters : state.best_parameters;
  bundle.normaliser = normaliser;
  bundle.sample_period_s = spec.sample_period_s;
  bundle.names = {used.input_names, used.output_names, used.state_names};
  bundle.training = ToJson(spec);
  bundle.provenance = {{"systems", fleet.trajectories.size()}, {"iterations", state.iteration}};
  if (!systems.validation.empty()) bundle.provenance["validation_loss"] = state.best_validation_loss;
  std::vector<size_t> judges = systems.validation.empty() ? split.training : split.validation;
  if (judges.size() > kNoiseSystems) judges.resize(kNoiseSystems);
  METAEKF_ASSIGN_OR_RETURN(bundle.noise, NoiseOfAdaptedModels(bundle, spec, Pick(used.trajectories, judges), executor));
  return bundle;
}

std::string WriteCheckpoint(const TrainingState& state, const std::string& training_digest) {
  nssm::Safetensors file;
  const auto add = [&file](const std::string& name, const std::vector<double>& values) {
    file.tensors.push_back({.name = name, .shape = {static_cast<int64_t>(values.size())}, .values = values});
  };
  add("parameters", state.parameters);
  add("first_moment", state.first_moment);
  add("second_moment", state.second_moment);
  add("best_parameters", state.best_parameters);
  file.metadata = {{"training", training_digest},
                   {"iteration", std::to_string(state.iteration)},
                   {"best_validation_loss", base::FormatExact(state.best_validation_loss)},
                   {"validation_loss", base::FormatExact(state.validation_loss)},
                   {"training_loss", base::FormatExact(state.training_loss)}};
  return nssm::WriteSafetensors(file);
}

absl::StatusOr<TrainingState> ReadCheckpoint(const std::string& bytes, const std::string& training_digest) {
  METAEKF_ASSIGN_OR_RETURN(nssm::Safetensors file, nssm::ReadSafetensors(bytes));
  if (file.metadata["training"] != training_digest) {
    return absl::InvalidArgumentError("the checkpoint belongs to another training");
  }
  TrainingState state;
  const auto number = [&file](const std::string& name) { return base::ParseDouble(file.metadata[name]); };
  const auto iteration = number("iteration"), best = number("best_validation_loss"), validation = number("validation_loss"),
             training = number("training_loss");
  if (!iteration || !best || !validation || !training) {
    return absl::InvalidArgumentError("the checkpoint's metadata is damaged");
  }
  state.iteration = static_cast<int32_t>(*iteration);
  state.best_validation_loss = *best;
  state.validation_loss = *validation;
  state.training_loss = *training;
  for (nssm::Safetensors::Tensor& tensor : file.tensors) {
    if (tensor.name == "parameters") state.parameters = std::move(tensor.values);
    if (tensor.name == "first_moment") state.first_moment = std::move(tensor.values);
    if (tensor.name == "second_moment") state.second_moment = std::move(tensor.values);
    if (tensor.name == "best_parameters") state.best_parameters = std::move(tensor.values);
  }
  const size_t size = state.parameters.size();
  if (size == 0 || state.first_moment.size() != size || state.second_moment.size() != size ||
      state.best_parameters.size() != size) {
    return absl::InvalidArgumentError("the checkpoint lacks a tensor");
  }
  return state;
}

}  // namespace metaekf::meta
