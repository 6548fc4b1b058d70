#include <algorithm>
#include <cmath>
#include <limits>

#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/data/split.h"
#include "core/experiments/classical.h"
#include "core/experiments/jobs.h"
#include "core/experiments/learner.h"
#include "core/experiments/studies.h"
#include "core/plot/box_plot.h"
#include "core/plot/svg.h"
#include "core/sim/simulate.h"

namespace metaekf::experiments {
namespace {

using data::Trajectory;
using Eigen::MatrixXd;
using nlohmann::json;

constexpr int64_t kContextSamples = 400;
constexpr int64_t kHorizon = 5;           // H_p of the paper
constexpr uint64_t kFirstSeed = 1;        // of the runs; hyperparameters were chosen on seeds from 1000 on
constexpr uint64_t kTargetSeeds = 1 << 20;  // added: targets are no systems of the fleet
constexpr int kArxOrder = 5;
constexpr double kDiverged = 1e8;         // squared error of 3,000 samples: hundreds beyond any oscillation
constexpr double kInfinity = std::numeric_limits<double>::infinity();

struct Scale {
  int runs;
  int64_t sources;
  std::optional<int64_t> source_samples;  // without it, drawn for each: 10 to 40 s
  int64_t predicted_samples;
  bool short_training;
};

Scale ScaleOf(const Options& options) {
  Scale scale = options.budget == Budget::kFull    ? Scale{20, 200, {}, 3000, false}
                : options.budget == Budget::kQuick ? Scale{1, 200, {}, 3000, false}
                                                   : Scale{2, 4, 400, 30, true};
  if (options.seeds) scale.runs = *options.seeds;
  return scale;
}

/// What the models share, unless it is said below: x⁺ = 𝓓x 𝓐 𝓔 x with linear 𝓔 and 𝓓.
constexpr char kCommon[] = R"json({
  "model": {
    "case": "STATE_INPUT_OUTPUT", "latent_size": 8, "precision": "FLOAT64",
    "transition": {"form": "AUTONOMOUS", "bypass": "SKIP", "block": {"hidden_widths": [16], "activation": "TANH"}}
  },
  "loss": {"horizon": 20, "stride": 40, "rollout": "STATE", "output_weight": 0},
  "context_samples": 400, "target_samples": 400, "task_batch": 4, "clip_norm": 1, "validation_period": 100,
  "iterations": 4000, "warmup_iterations": 2000, "warmup_horizon": 20,
  "warmup_lr": 0.01, "outer_lr": 0.003, "final_outer_lr": 1e-4
})json";

struct Variant {
  const char* label;
  plot::Colour colour;
  TrainingData data;
  const char* changes;  // to kCommon
};

// MAML: gradient descent goes far only along directions of much curvature, so there is but one, a feature that the network
// learns beside a linear bypass that need not adapt. Contexts in training are what the target's is: the first samples, before
// the limit cycle. SSM sees nothing else: without a bypass its states stay bounded wherever a free run takes them, while
// with one a run in seven diverged. Xfer adapts what served it best, its last layer.
constexpr Variant kVariants[] = {
    {"MAML", plot::Colour::kBlue, TrainingData::kFleet, R"json({
       "algorithm": "MAML",
       "model": {"transition": {"bypass": "LINEAR", "increment_scale": 0.02, "block": {"hidden_widths": [24, 24, 1]}}},
       "contexts_at_start": true,
       "iterations": 12000, "warmup_iterations": 3000, "warmup_horizon": 10, "final_outer_lr": 2e-5, "clip_norm": 0.1,
       "inner_loop": {"steps": 5, "learning_rate": 1, "learned_rates": true, "curvature_rates": true,
                      "adapted_mask": "transition.3.weight"},
       "adaptation": {"steps": 10}})json"},
    {"Gaussian prior", plot::Colour::kVermilion, TrainingData::kFleet, R"json({
       "algorithm": "GAUSSIAN_PRIOR",
       "model": {"latent_size": 2, "transition": {"block": {"output_scale": 0.01}}},
       "loss": {"horizon": 50, "stride": 100, "output_weight": 1}, "validation_share": 0.5,
       "gaussian_prior": {"restarts": 3, "rounds": 2, "first_steps": 25, "round_steps": 6},
       "adaptation": {"optimiser": "LEVENBERG_MARQUARDT", "steps": 0}})json"},
    {"SSM", plot::Colour::kGreen, TrainingData::kContext, R"json({
       "algorithm": "SUPERVISED", "model": {"transition": {"bypass": "NONE"}}, "task_batch": 1, "validation_share": 0,
       "iterations": 400, "warmup_iterations": 0, "outer_lr": 0.01, "final_outer_lr": 0.001, "adaptation": {"steps": 0}})json"},
    {"All-NoAdapt", plot::Colour::kPurple, TrainingData::kFleetAndContext, R"json({
       "algorithm": "SUPERVISED", "iterations": 20000, "warmup_iterations": 10000, "final_outer_lr": 2e-5,
       "adaptation": {"steps": 0}})json"},
    {"Xfer", plot::Colour::kOrange, TrainingData::kFleet, R"json({
       "algorithm": "SUPERVISED", "model": {"transition": {"block": {"hidden_widths": [24, 24]}}},
       "iterations": 20000, "warmup_iterations": 10000, "final_outer_lr": 2e-5,
       "adaptation": {"steps": 40, "learning_rate": 3e-4, "adapted_mask": "transition.2"}})json"},
};
constexpr const char* kMetaLearners[] = {"MAML", "Gaussian prior"};
constexpr const char* kBaselines[] = {"SSM", "All-NoAdapt", "Xfer"};

std::vector<Learner> Learners(const Scale& scale) {
  std::vector<Learner> learners;
  for (const Variant& variant : kVariants) {
    json specification = json::parse(kCommon);
    specification.merge_patch(json::parse(variant.changes));
    if (scale.short_training) {
      specification.merge_patch(
          {{"iterations", 12}, {"warmup_iterations", 6}, {"gaussian_prior", {{"rounds", 1}, {"restarts", 1}, {"first_steps", 4}, {"round_steps", 2}}}});
      if (specification["adaptation"]["steps"] == 40) specification["adaptation"]["steps"] = 5;
    }
    learners.push_back({variant.label, variant.data, std::move(specification)});
  }
  return learners;
}

std::vector<ClassicalModel> ClassicalModels() {
  return {Arx(kArxOrder), OutputError(kArxOrder), PolynomialNarx(1, 3)};
}

sim::Request FleetOf(const Scale& scale, uint64_t seed) {
  return {.system = "van-der-pol", .systems = scale.sources, .seed = seed, .steps = scale.source_samples};
}

/// The first run's target is the paper's, the others are drawn as the fleet is.
sim::Request TargetOf(const Scale& scale, uint64_t seed) {
  sim::Request request{.system = "van-der-pol", .systems = 1, .seed = seed + kTargetSeeds,
                       .steps = kContextSamples + scale.predicted_samples};
  if (seed == kFirstSeed) request.settings["nominal"] = "1";
  return request;
}

json Protocol(const Options& options) {
  const Scale scale = ScaleOf(options);
  json learners = json::array(), classical = json::array();
  for (const Learner& learner : Learners(scale)) learners.push_back(ToJson(learner));
  for (const ClassicalModel& model : ClassicalModels()) classical.push_back(model.label);
  return {{"experiment", "van-der-pol-comparison"},
          {"runs", scale.runs},
          {"first_seed", kFirstSeed},
          {"target_seed", absl::StrCat("seed + ", kTargetSeeds)},
          {"first_target", "the paper's: theta 1.572, x (1, -0.5)"},
          {"sources", scale.sources},
          {"noise_std", 0},
          {"context_samples", kContextSamples},
          {"predicted_samples", scale.predicted_samples},
          {"block_horizon", kHorizon},
          {"learners", learners},
          {"classical", classical}};
}

/// What one model of one run has achieved. Infinite where it diverged.
struct Trial {
  double free_run = kInfinity, in_blocks = kInfinity, one_step = kInfinity;  // Σ (x − x̂)² over samples and components
  double training_s = std::numeric_limits<double>::quiet_NaN(), adaptation_s = std::numeric_limits<double>::quiet_NaN();
  MatrixXd free_states;
};

double SquaredError(const MatrixXd& prediction, const MatrixXd& truth) {
  const double error = (prediction - truth).squaredNorm();
  return error < kDiverged ? error : kInfinity;
}

absl::Status Judge(const SystemModel& model, const Trajectory& recording, Trial* trial) {
  const MatrixXd truth = recording.states.rightCols(recording.length() - kContextSamples);
  METAEKF_ASSIGN_OR_RETURN(trial->free_states, PredictFreely(model, recording, kContextSamples));
  METAEKF_ASSIGN_OR_RETURN(const MatrixXd in_blocks, PredictInBlocks(model, recording, kContextSamples, kHorizon));
  METAEKF_ASSIGN_OR_RETURN(const Trajectory later, data::SamplesFrom(recording, kContextSamples - model.warmup));
  METAEKF_ASSIGN_OR_RETURN(const MatrixXd one_step, model.predict(later, nssm::PredictionMode::kOneStep));
  trial->free_run = SquaredError(trial->free_states, truth);
  trial->in_blocks = SquaredError(in_blocks, truth);
  trial->one_step = SquaredError(one_step.rightCols(truth.cols()), truth);
  return absl::OkStatus();
}

absl::StatusOr<Trial> RunTrial(const Scale& scale, uint64_t seed, size_t model_index) {
  base::Executor* const serial = base::CallingThread();
  METAEKF_ASSIGN_OR_RETURN(const sim::Fleet target, sim::Simulate(TargetOf(scale, seed), *serial));
  const Trajectory& recording = target.dataset.trajectories[0];
  METAEKF_ASSIGN_OR_RETURN(const Trajectory context, data::FirstSamples(recording, kContextSamples));
  const std::vector<Learner> learners = Learners(scale);
  Trial trial;
  const double begin = ThreadSeconds();
  if (model_index >= learners.size()) {
    METAEKF_ASSIGN_OR_RETURN(const SystemModel model, ClassicalModels()[model_index - learners.size()].fit(context));
    trial.adaptation_s = ThreadSeconds() - begin;
    METAEKF_RETURN_IF_ERROR(Judge(model, recording, &trial));
    return trial;
  }
  METAEKF_ASSIGN_OR_RETURN(const sim::Fleet fleet, sim::Simulate(FleetOf(scale, seed), *serial));
  const absl::StatusOr<nssm::Bundle> bundle = TrainLearner(learners[model_index], fleet.dataset, context, seed, serial);
  if (IsDivergence(bundle.status())) return trial;
  METAEKF_RETURN_IF_ERROR(bundle.status());
  const double trained = ThreadSeconds();
  trial.training_s = trained - begin;
  const absl::StatusOr<SystemModel> model = AdaptToContext(*bundle, context);
  if (IsDivergence(model.status())) return trial;
  METAEKF_RETURN_IF_ERROR(model.status());
  trial.adaptation_s = ThreadSeconds() - trained;
  METAEKF_RETURN_IF_ERROR(Judge(*model, recording, &trial));
  return trial;
}

/// Trials of every model in turn, one per run.
struct Results {
  std::vector<std::string> labels;
  std::vector<std::vector<Trial>> trials;

  std::vector<double> Values(size_t model, double Trial::*quantity) const {
    std::vector<double> values;
    for (const Trial& trial : trials[model]) values.push_back(trial.*quantity);
    return values;
  }
  size_t IndexOf(const std::string& label) const {
    return static_cast<size_t>(std::find(labels.begin(), labels.end(), label) - labels.begin());
  }
  double MedianFreeRun(const std::string& label) const {
    return Summarise(Values(IndexOf(label), &Trial::free_run), false).median;
  }
};

Table Errors(const Results& results, const Scale& scale) {
  Table table{.name = "errors",
              .title = absl::StrCat("Sum of squared errors of both states over ", scale.predicted_samples,
                                    " samples after a context of ", kContextSamples, "; median [quartiles] of ", scale.runs,
                                    " runs"),
              .row_heading = "model",
              .columns = {{"free run"}, {"5 steps ahead"}, {"1 step ahead"}}};
  for (size_t i = 0; i < results.labels.size(); ++i) {
    table.rows.push_back({results.labels[i],
                          {results.Values(i, &Trial::free_run), results.Values(i, &Trial::in_blocks),
                           results.Values(i, &Trial::one_step)}});
  }
  table.notes = {"Data are free of noise, and the system is a polynomial of degree 3: the polynomial NARX model is exact."};
  return table;
}

Table Times(const Results& results) {
  Table table{.name = "times", .title = "Processor time", .row_heading = "model",
              .columns = {{"training", "s"}, {"adaptation or fit", "s"}}};
  for (size_t i = 0; i < results.labels.size(); ++i) {
    table.rows.push_back(
        {results.labels[i], {results.Values(i, &Trial::training_s), results.Values(i, &Trial::adaptation_s)}});
  }
  return table;
}

/// The label with the least median error in free run.
template <size_t N>
std::string Best(const Results& results, const char* const (&labels)[N]) {
  return *std::min_element(std::begin(labels), std::end(labels), [&results](const char* a, const char* b) {
    return results.MedianFreeRun(a) < results.MedianFreeRun(b);
  });
}

std::vector<std::string> Findings(const Results& results) {
  const std::string learner = Best(results, kMetaLearners), baseline = Best(results, kBaselines);
  const double reference = results.MedianFreeRun(baseline);
  const auto ratio = [&](const std::string& label) { return base::FormatShort(results.MedianFreeRun(label) / reference, 3); };
  size_t diverged = 0;
  for (size_t i = 0; i < std::size(kVariants); ++i) {
    const std::vector<Trial>& trials = results.trials[i];
    diverged += static_cast<size_t>(
        std::count_if(trials.begin(), trials.end(), [](const Trial& trial) { return std::isinf(trial.free_run); }));
  }
  return {absl::StrCat("Best of the supervised and transferred models in free run: ", baseline, "."),
          absl::StrCat("Median error of ", learner, ", the best meta-learner, in its ratio to that: ", ratio(learner), "."),
          absl::StrCat("Median error of MAML in the same ratio: ", ratio("MAML"), "."),
          absl::StrCat("Runs of neural models that diverged: ", diverged, ".")};
}

/// Cumulative squared error of one trial.
std::vector<double> Growth(const Trial& trial, const MatrixXd& truth) {
  std::vector<double> growth;
  double sum = 0;
  for (Eigen::Index t = 0; t < truth.cols(); ++t) {
    sum += trial.free_states.cols() == truth.cols() ? (trial.free_states.col(t) - truth.col(t)).squaredNorm() : kInfinity;
    growth.push_back(std::isfinite(sum) ? sum : kInfinity);
  }
  return growth;
}

/// Errors in free run of all runs, the exact NARX aside.
absl::StatusOr<Picture> DrawDistribution(const Results& results) {
  plot::BoxPlot picture{.title = "Errors in free run, all runs", .x_label = "sum of squared errors", .logarithmic = true};
  for (const Variant& variant : kVariants) {
    const std::vector<double> errors = results.Values(results.IndexOf(variant.label), &Trial::free_run);
    const size_t failed = Summarise(errors, false).failed;
    picture.boxes.push_back({.label = failed == 0 ? variant.label : absl::StrCat(variant.label, " (", failed, " failed)"),
                             .values = errors, .colour = variant.colour});
  }
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg(picture));
  return Picture{"error-distribution", std::move(svg)};
}

/// States of the first run, and the growth of the error, median of all runs: of the neural models.
absl::StatusOr<Picture> Draw(const Results& results, const std::vector<MatrixXd>& truths, double period_s) {
  std::vector<double> times;
  for (Eigen::Index t = 0; t < truths[0].cols(); ++t) times.push_back(static_cast<double>(t + kContextSamples) * period_s);
  plot::Figure figure{.title = "Free run after 4 s of context", .x_label = "t (s)"};
  for (const Eigen::Index state : {0, 1}) {
    plot::Panel panel{.y_label = absl::StrCat("x", state + 1, " (run 1)")};
    panel.series.push_back({.label = "true", .x = times, .y = RowOf(truths[0], state), .mark = plot::Mark::kDashes,
                            .colour = plot::Colour::kBlack});
    for (const Variant& variant : kVariants) {
      const Trial& trial = results.trials[results.IndexOf(variant.label)][0];
      if (trial.free_states.cols() != truths[0].cols()) continue;
      panel.series.push_back(
          {.label = variant.label, .x = times, .y = RowOf(trial.free_states, state), .colour = variant.colour});
    }
    figure.panels.push_back(std::move(panel));
  }
  plot::Panel errors{.y_label = "SSE so far, median", .logarithmic_y = true};
  for (size_t i = 0; i < std::size(kVariants); ++i) {
    std::vector<std::vector<double>> at(times.size());
    for (size_t run = 0; run < truths.size(); ++run) {
      const std::vector<double> growth = Growth(results.trials[i][run], truths[run]);
      for (size_t t = 0; t < times.size(); ++t) at[t].push_back(growth[t]);
    }
    plot::Series series{.label = kVariants[i].label, .x = times, .colour = kVariants[i].colour};
    for (const auto& values : at) series.y.push_back(Summarise(values, false).median);
    errors.series.push_back(std::move(series));
  }
  figure.panels.push_back(std::move(errors));
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg(figure));
  return Picture{"van-der-pol-comparison", std::move(svg)};
}

absl::StatusOr<Report> Run(const Options& options, base::Executor* executor, const OnProgress& on_progress) {
  const Scale scale = ScaleOf(options);
  Results results;
  for (const Variant& variant : kVariants) results.labels.emplace_back(variant.label);
  for (const ClassicalModel& model : ClassicalModels()) results.labels.push_back(model.label);
  const size_t models = results.labels.size(), runs = static_cast<size_t>(scale.runs);
  results.trials.assign(models, std::vector<Trial>(runs));
  const absl::Status studied = RunJobs(models * runs, executor, "models trained", on_progress, [&](size_t job) {
    const size_t run = job / models, model = job % models;
    METAEKF_ASSIGN_OR_RETURN(results.trials[model][run], RunTrial(scale, kFirstSeed + run, model));
    return absl::OkStatus();
  });
  METAEKF_RETURN_IF_ERROR(studied);
  std::vector<MatrixXd> truths;
  double period_s = 0;
  base::Executor* const serial = base::CallingThread();
  for (size_t run = 0; run < runs; ++run) {
    METAEKF_ASSIGN_OR_RETURN(const sim::Fleet target, sim::Simulate(TargetOf(scale, kFirstSeed + run), *serial));
    truths.push_back(target.dataset.trajectories[0].states.rightCols(scale.predicted_samples));
    period_s = target.dataset.trajectories[0].sample_period_s;
  }
  METAEKF_ASSIGN_OR_RETURN(Picture picture, Draw(results, truths, period_s));
  METAEKF_ASSIGN_OR_RETURN(Picture distribution, DrawDistribution(results));
  return Report{{Errors(results, scale), Times(results)}, Findings(results), {std::move(picture), std::move(distribution)}};
}

}  // namespace

Experiment VanDerPolComparison() {
  return {"van-der-pol-comparison",
          "MAML and a learned prior against supervised and transfer learning on van der Pol oscillators", Protocol, Run};
}

}  // namespace metaekf::experiments
