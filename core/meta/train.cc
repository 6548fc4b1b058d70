#include "core/meta/train.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <nlohmann/json.hpp>

#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/data/split.h"
#include "core/filter/calibrate.h"
#include "core/filter/noise.h"
#include "core/meta/adapt.h"
#include "core/meta/empirical_bayes.h"
#include "core/meta/inner_loop.h"
#include "core/meta/outer_loop.h"
#include "core/nssm/loss.h"

namespace metaekf::meta {
namespace {

using data::Dataset;
using data::Trajectory;
using nssm::Bundle;
using nssm::ModelSpec;

/// Systems whose filters give the default covariances: those held out, then those trained on.
struct Judges {
  std::vector<size_t> systems;
  size_t held_out = 0;  ///< so many of them, the first, were
  size_t whole = 0;     ///< so many of them, the first, say all of the noise, which takes time that grows with the size of the state; the rest how wide bounds must be
};

Judges ChooseJudges(const TrainingSpec& spec, const data::Split& split) {
  constexpr size_t kFleet = 10, kTellApart = 16, kMost = 400;
  constexpr int32_t kFewestWhole = 8, kMostWhole = 80, kWork = 240;
  const ModelSpec& model = spec.model;
  Judges judges{.systems = split.validation, .held_out = split.validation.size()};
  // A small fleet is known by heart, and so are systems whose fits a prior has among its examples. They say nothing of noise, and how wide bounds
  // must be only beside so many others that the difference shows.
  const bool by_heart = spec.algorithm == Algorithm::kGaussianPrior || split.training.size() + split.validation.size() < kFleet;
  const bool count = judges.systems.empty() || !by_heart;
  if (count || judges.held_out >= kTellApart) judges.systems.insert(judges.systems.end(), split.training.begin(), split.training.end());
  judges.systems.resize(std::min(judges.systems.size(), kMost));
  const int32_t most = std::clamp(kWork / std::max(model.is_case_one() ? model.latent_size : model.state_size, 1), kFewestWhole, kMostWhole);
  judges.whole = std::min({count ? judges.systems.size() : judges.held_out, static_cast<size_t>(most)});
  return judges;
}

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
  return ReadTrainingSpec(ToJson(*spec)).status();
}

/// A field stays free of curl through the normalisation only if its components share a scale, and so do the positions: one for the
/// field and another for the positions, whose units have nothing to do with each other.
std::vector<data::ScaleGroup> ScaleGroups(const ModelSpec& model) {
  if (!model.is_curl_free()) return {};
  data::ScaleGroup field, position;
  for (int32_t i = 0; i < model.output_size; ++i) field.outputs.push_back(i);
  position.states.assign(model.curl_free_positions.begin(), model.curl_free_positions.end());
  return {field, position};
}

/// Before a prior is learned: what a meta-learner finds, if one is asked for and the prior has not begun yet. Leaves the state as the prior begins.
absl::StatusOr<LearnedStart> SharedParameters(const TrainingSpec& spec, const nssm::Model& model, const nn::Mask& mask,
                                                     const Systems& systems, base::Executor* executor, TrainingState* state,
                                                     const OnTrainingStep& on_step) {
  if (spec.gaussian_prior.meta_iterations == 0 || state->values.contains(kPriorHasBegun)) return LearnedStart();
  TrainingSpec meta = spec;
  meta.algorithm = spec.gaussian_prior.meta_algorithm;
  meta.iterations = spec.gaussian_prior.meta_iterations;
  const int32_t iterations = PriorIterations(spec.gaussian_prior, systems.training.size());
  const auto tell = [&](const TrainingProgress& progress) {
    return !on_step || on_step({progress.state, iterations, progress.validated, progress.diverged});
  };
  METAEKF_ASSIGN_OR_RETURN(LearnedStart learned, RunOuterLoop(meta, model, mask, systems, executor, state, tell));
  *state = TrainingState();
  return learned;
}

/// What a filter of a system is calibrated on: at most so many samples behind its context, and of all systems together, those that say only
/// how wide bounds must be apart, or all of a recording that is hardly longer than that.
constexpr int64_t kCalibrationSamples = 2000, kAllCalibrationSamples = 48'000, kAllWidthSamples = 240'000, kFewSamples = 50;
constexpr double kLogStds[] = {0, 0.25, 0.5, 1, 2};  // 0, the fleet's own, comes first

/// How far systems' own Q and R are from the fleet's (FilterNoise::log_std): with which of kLogStds what the tails of contexts say helps most
/// to explain what comes after; and how much less their bounds hold of it than the fleet's do (FilterNoise::own_widening).
/// @param runs  that, a run for each context. @param noise  receives both.
void FindOwnNoise(const Bundle& bundle, const AdaptationOptions& options, const std::vector<Trajectory>& contexts,
                  const std::vector<filter::CalibrationRun>& runs, base::Executor* executor, nssm::FilterNoise* noise) {
  const std::vector<double> candidates(std::begin(kLogStds), std::end(kLogStds));
  std::vector<std::vector<filter::Explanation>> of_systems(contexts.size());
  executor->ParallelFor(contexts.size(), [&](size_t i, size_t) {
    const absl::StatusOr<std::vector<nssm::FilterNoise>> noises = NoiseOfContext(bundle, contexts[i], options, candidates);
    if (!noises.ok()) return;  // says nothing, as above
    Bundle own = bundle;
    for (const nssm::FilterNoise& found : *noises) {
      own.noise = found;
      of_systems[i].push_back(filter::Explain(own, {runs[i]}, base::CallingThread()));
      if (std::isfinite(of_systems[i].back().likelihood)) continue;
      of_systems[i].clear();  // a filter that loses the system says nothing of the others
      return;
    }
  });
  noise->log_std = 0;  // where none says anything
  double most = -std::numeric_limits<double>::infinity(), of_fleet = 0;
  for (size_t c = 0; c < candidates.size(); ++c) {
    double sum = 0;
    std::vector<double> ratios;
    for (const std::vector<filter::Explanation>& own : of_systems) {
      if (own.empty()) continue;
      sum += own[c].likelihood;
      ratios.insert(ratios.end(), own[c].ratios.begin(), own[c].ratios.end());
    }
    const double widening = filter::LogWidening(std::move(ratios));
    if (candidates[c] == 0) of_fleet = widening;
    if (!(sum > most)) continue;
    most = sum;
    noise->log_std = candidates[c];
    noise->own_widening = std::max(0.0, widening - of_fleet);
  }
}

/// Default Q, R and P₀ from the residuals of the model adapted to each of `systems`, Q and R scaled to what filters of these systems
/// meet after the context (filter::Calibrate), and how far from them a system's own may be.
/// @param systems  of `judges`, in their order.
absl::StatusOr<nssm::FilterNoise> NoiseOfAdaptedModels(Bundle bundle, const TrainingSpec& spec, const std::vector<Trajectory>& systems,
                                                       const Judges& judges, base::Executor* executor) {
  METAEKF_ASSIGN_OR_RETURN(const AdaptationOptions options, DefaultAdaptation(bundle));
  const int64_t wanted = std::max<int64_t>(spec.context_samples, ContextSamplesNeeded(spec.model, spec.loss));
  std::vector<std::optional<Bundle>> adapted(systems.size());
  executor->ParallelFor(systems.size(), [&](size_t i, size_t) {
    const absl::StatusOr<Trajectory> context = data::FirstSamples(systems[i], std::min<int64_t>(systems[i].length(), wanted));
    absl::StatusOr<Bundle> found = AdaptedBundle(bundle, *context, options);
    // An adaptation that diverges says nothing about noise; the unadapted model stands in.
    adapted[i] = found.ok() ? *std::move(found) : bundle;
  });
  const auto most = [](int64_t samples, size_t of) { return std::min(kCalibrationSamples, samples / std::max<int64_t>(static_cast<int64_t>(of), 1)); };
  const int64_t most_whole = most(kAllCalibrationSamples, judges.whole), most_else = most(kAllWidthSamples, systems.size() - judges.whole);
  filter::NoiseEstimate noise(bundle);
  std::vector<filter::CalibrationRun> runs, later_runs;
  std::vector<Trajectory> contexts;  // of the later runs
  for (size_t i = 0; i < systems.size(); ++i) {
    const bool whole = i < judges.whole;
    METAEKF_ASSIGN_OR_RETURN(const Trajectory normalised, data::Normalised(bundle.normaliser, systems[i]));
    if (whole) noise.Add(adapted[i]->parameters, normalised);
    const int64_t begin = systems[i].length() - wanted < kFewSamples ? 0 : wanted;
    METAEKF_ASSIGN_OR_RETURN(const Trajectory later, data::SamplesFrom(systems[i], begin));
    METAEKF_ASSIGN_OR_RETURN(Trajectory run, data::FirstSamples(later, std::min(later.length(), whole ? most_whole : most_else)));
    runs.push_back(filter::RunOf(*adapted[i], std::move(run)));
    runs.back().trained_on = i >= judges.held_out;
    runs.back().width_only = !whole;
    if (begin == 0 || !whole) continue;
    METAEKF_ASSIGN_OR_RETURN(Trajectory context, data::FirstSamples(systems[i], wanted));
    contexts.push_back(std::move(context));
    later_runs.push_back(runs.back());
  }
  bundle.noise = noise.Result(bundle.normaliser);
  bundle.noise = filter::Calibrate(bundle, runs, std::numeric_limits<double>::infinity(), executor);
  if (!contexts.empty()) FindOwnNoise(bundle, options, contexts, later_runs, executor, &bundle.noise);
  return bundle.noise;
}

/// The rates that were learned become part of what the model file says of its training and of adaptation.
void KeepRates(const std::map<std::string, double>& rates, TrainingSpec* spec) {
  if (rates.empty()) return;
  spec->inner_loop.tensor_rates = rates;
  spec->inner_loop.curvature_rates = spec->adaptation.curvature_rates = false;
  if (spec->adaptation.learned_rates && spec->adaptation.optimiser == spec->inner_loop.optimiser) {
    spec->adaptation.tensor_rates = rates;
  }
}

std::vector<Trajectory> Pick(const std::vector<Trajectory>& from, const std::vector<size_t>& indices) {
  std::vector<Trajectory> picked;
  for (const size_t i : indices) picked.push_back(from[i]);
  return picked;
}

}  // namespace

absl::StatusOr<Bundle> Train(const TrainingSpec& given_spec, const Dataset& fleet, const TrainingState* resume,
                             base::Executor* executor, const OnTrainingStep& on_step) {
  TrainingSpec spec = given_spec;
  METAEKF_RETURN_IF_ERROR(FitSpecToData(fleet, &spec));
  if (spec.model.fits_start() && spec.algorithm != Algorithm::kGaussianPrior) {
    return absl::InvalidArgumentError("algorithm: a model whose start is FITTED is trained by GAUSSIAN_PRIOR");
  }
  METAEKF_RETURN_IF_ERROR(
      base::Annotate(nssm::ShapeOfLoss(spec.model, spec.loss, spec.context_samples).status(), "context_samples"));
  METAEKF_RETURN_IF_ERROR(
      base::Annotate(nssm::ShapeOfLoss(spec.model, spec.loss, spec.target_samples).status(), "target_samples"));
  METAEKF_ASSIGN_OR_RETURN(const data::Split split,
                           data::SplitSystems(fleet.trajectories.size(), spec.validation_share, spec.seed));

  Dataset used = fleet;
  if (spec.model.is_case_one()) {
    used.state_names.clear();
    for (Trajectory& trajectory : used.trajectories) trajectory.states.resize(0, trajectory.length());
  }
  METAEKF_ASSIGN_OR_RETURN(const Dataset training_set, data::Subset(used, split.training));
  METAEKF_ASSIGN_OR_RETURN(const data::Normaliser normaliser, data::FitNormaliser(training_set, ScaleGroups(spec.model)));
  nssm::TakeUnits(normaliser, &spec.model);
  METAEKF_ASSIGN_OR_RETURN(const nssm::Model model, nssm::Model::Create(spec.model));
  METAEKF_ASSIGN_OR_RETURN(const nn::Mask mask, nn::ParseMask(spec.inner_loop.adapted_mask, model.layout()));
  METAEKF_ASSIGN_OR_RETURN(const nn::Mask adaptation_mask, nn::ParseMask(spec.adaptation.adapted_mask, model.layout()));
  METAEKF_RETURN_IF_ERROR(CheckTensorRates(spec.inner_loop, model.layout()));
  METAEKF_RETURN_IF_ERROR(CheckTensorRates(spec.adaptation, model.layout()));
  std::vector<Trajectory> normalised;
  for (const Trajectory& trajectory : used.trajectories) {
    METAEKF_ASSIGN_OR_RETURN(Trajectory n, data::Normalised(normaliser, trajectory));
    normalised.push_back(std::move(n));
  }

  TrainingState state = resume != nullptr ? *resume : TrainingState();
  const Systems systems{Pick(normalised, split.training), Pick(normalised, split.validation)};
  Bundle bundle{.model = model};
  if (spec.algorithm == Algorithm::kGaussianPrior) {
    METAEKF_ASSIGN_OR_RETURN(const LearnedStart shared, SharedParameters(spec, model, mask, systems, executor, &state, on_step));
    METAEKF_ASSIGN_OR_RETURN(LearnedPrior learned, LearnGaussianPrior(spec, model, adaptation_mask, systems, shared, executor, &state, on_step));
    bundle.parameters = std::move(learned.parameters);
    bundle.prior = std::move(learned.prior);
  } else {
    METAEKF_ASSIGN_OR_RETURN(LearnedStart learned, RunOuterLoop(spec, model, mask, systems, executor, &state, on_step));
    bundle.parameters = std::move(learned.parameters);
    KeepRates(learned.tensor_rates, &spec);
  }
  bundle.normaliser = normaliser;
  bundle.sample_period_s = spec.sample_period_s;
  bundle.names = {used.input_names, used.output_names, used.state_names};
  bundle.training = ToJson(spec);
  nlohmann::json provenance = {{"systems", fleet.trajectories.size()}, {"iterations", state.iteration}};
  if (std::isfinite(state.best_validation_loss)) provenance["validation_loss"] = state.best_validation_loss;
  bundle.provenance = std::move(provenance);
  const Judges judges = ChooseJudges(spec, split);
  METAEKF_ASSIGN_OR_RETURN(bundle.noise, NoiseOfAdaptedModels(bundle, spec, Pick(used.trajectories, judges.systems), judges, executor));
  return bundle;
}

}  // namespace metaekf::meta
