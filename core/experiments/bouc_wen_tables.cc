#include <algorithm>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>
#include <optional>

#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/data/split.h"
#include "core/experiments/bouc_wen_data.h"
#include "core/experiments/bouc_wen_learners.h"
#include "core/experiments/classical.h"
#include "core/experiments/jobs.h"
#include "core/experiments/studies.h"
#include "core/plot/box_plot.h"
#include "core/plot/svg.h"

namespace metaekf::experiments {
namespace {

using data::Trajectory;
using Eigen::MatrixXd;
using nlohmann::json;

constexpr uint64_t kFirstSeed = 1;        // of runs: fleet and training
constexpr uint64_t kSignalSeed = 555001;  // + run: of the simulated estimation signal
constexpr uint64_t kTestSeed = 666001;    // + run: of the tests
constexpr int64_t kScoredFrom = 64;       // of a test: beyond the warm-up of every model
constexpr int64_t kPeriodSamples = 750;   // of 120 sin 2πt
constexpr int kFullSteps = 500;           // of Adam at adaptation: one target bears more than the hundred of a few-shot curve
constexpr double kDiverged = 1;         // m, a thousand times the signal: an error beyond it is a failure, whatever its size
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

struct Scale {
  int runs;
  int64_t systems, fleet_samples;
  int64_t tests, test_samples;
  std::vector<int64_t> lengths;
};

Scale ScaleOf(const Options& options) {
  Scale scale = options.budget == Budget::kFull    ? Scale{2, 40, 10000, 2, 8192, {500, 8192, 32768, 40960}}
                : options.budget == Budget::kQuick ? Scale{1, 24, 2048, 1, 4096, {500, 8192}}
                                                   : Scale{1, 4, 300, 1, 200, {120, 200}};
  if (options.seeds) scale.runs = *options.seeds;
  if (options.recording) {
    std::erase_if(scale.lengths, [&options](int64_t length) { return length > options.recording->length(); });
  }
  return scale;
}

struct FleetKind {
  const char* label;
  BoucWenExcitation excitation;
};
constexpr FleetKind kFleets[] = {{"sine fleet", BoucWenExcitation::kSine}, {"multisine fleet", BoucWenExcitation::kMultisine}};

std::vector<ClassicalModel> ClassicalModels() { return {Arx(5), OutputError(5), PolynomialNarx(3, 3)}; }

/// Those of the fleet, and one for all systems, the target among them.
std::vector<Learner> Learners(Budget budget) {
  std::vector<Learner> learners = BoucWenLearners(budget);
  for (Learner& learner : learners) {
    const bool by_gradients = learner.specification.value(json::json_pointer("/adaptation/optimiser"), "") == "ADAM";
    if (budget == Budget::kFull && by_gradients) learner.specification["adaptation"]["steps"] = kFullSteps;
  }
  const auto transferred =
      std::find_if(learners.begin(), learners.end(), [](const Learner& one) { return one.label == "Xfer"; });
  Learner universal{"Univ", TrainingData::kFleetAndContext, transferred->specification};
  universal.specification["adaptation"]["steps"] = 0;
  learners.push_back(std::move(universal));
  learners.push_back(PrintedMaml(budget));
  return learners;
}

json Protocol(const Options& options) {
  const Scale scale = ScaleOf(options);
  json learners = json::array(), classical = json::array(), fleets = json::array();
  for (const Learner& learner : Learners(options.budget)) learners.push_back(ToJson(learner));
  for (const ClassicalModel& model : ClassicalModels()) classical.push_back(model.label);
  for (const FleetKind& fleet : kFleets) fleets.push_back(fleet.label);
  return {{"experiment", "bouc-wen-tables"},
          {"runs", scale.runs},
          {"first_seed", kFirstSeed},
          {"estimation_signal", options.recording ? "measured" : absl::StrCat("simulated, seed ", kSignalSeed, " + run")},
          {"fleets", fleets},
          {"systems", scale.systems},
          {"fleet_samples", scale.fleet_samples},
          {"noise_std_m", kBoucWenNoiseM},
          {"context_samples", scale.lengths},
          {"tests", {{"count", scale.tests}, {"samples", scale.test_samples}, {"seed", absl::StrCat(kTestSeed, " + run")},
                     {"scored_from", kScoredFrom}}},
          {"learners", learners},
          {"classical", classical}};
}

/// How good one model is after one length of context; nothing measured where it needs more.
struct Outcome {
  bool measured = false;
  double one_step_rmse = kNan, one_step_fit = kNan, free_rmse = kNan, free_fit = kNan, seconds = kNan, memory_mib = kNan;
  MatrixXd free;  // of the first test
};

absl::Status Judge(const SystemModel& model, const std::vector<Trajectory>& tests, Outcome* outcome) {
  std::vector<MatrixXd> truths, one_step, free;
  for (const Trajectory& test : tests) {
    METAEKF_ASSIGN_OR_RETURN(MatrixXd freely, PredictFreely(model, test, kScoredFrom));
    METAEKF_ASSIGN_OR_RETURN(const MatrixXd next, model.predict(test, nssm::PredictionMode::kOneStep));
    truths.push_back(test.outputs.rightCols(freely.cols()));
    one_step.push_back(next.rightCols(freely.cols()));
    free.push_back(std::move(freely));
  }
  const nssm::Score near = nssm::ScorePredictions(truths, one_step), far = nssm::ScorePredictions(truths, free);
  if (near.rmse[0] < kDiverged) {
    outcome->one_step_rmse = near.rmse[0];
    outcome->one_step_fit = near.fit_percent[0];
  }
  if (far.rmse[0] < kDiverged) {
    outcome->free_rmse = far.rmse[0];
    outcome->free_fit = far.fit_percent[0];
  }
  outcome->free = std::move(free[0]);
  return absl::OkStatus();
}

/// Models, each with outcomes by run and length.
struct Results {
  std::vector<std::string> labels;
  std::vector<std::vector<double>> training_s, training_mib;
  std::vector<std::vector<std::vector<Outcome>>> outcomes;

  size_t IndexOf(const std::string& label) {
    const auto place = std::find(labels.begin(), labels.end(), label);
    if (place != labels.end()) return static_cast<size_t>(place - labels.begin());
    labels.push_back(label);
    training_s.emplace_back();
    training_mib.emplace_back();
    outcomes.emplace_back();
    return labels.size() - 1;
  }
};

/// What is measured of the target in one run.
struct Target {
  Trajectory signal;
  std::vector<Trajectory> tests;
};

absl::StatusOr<Target> MakeTarget(const Options& options, const Scale& scale, uint64_t run, base::Executor* executor) {
  Target target;
  METAEKF_ASSIGN_OR_RETURN(target.tests, NominalBoucWen(scale.tests, scale.test_samples, 0, kTestSeed + run, executor));
  if (options.recording) {
    target.signal = *options.recording;
    return target;
  }
  METAEKF_ASSIGN_OR_RETURN(const std::vector<Trajectory> signals,
                           NominalBoucWen(1, scale.lengths.back(), kBoucWenNoiseM, kSignalSeed + run, executor));
  target.signal = signals[0];
  return target;
}

using Fit = std::function<absl::StatusOr<SystemModel>(const Trajectory& context)>;

/// Fits models at every length, side by side; at the greatest one after the other, for their memory to be told apart. Judges
/// them side by side.
absl::Status JudgeAll(const std::vector<std::pair<size_t, Fit>>& models, const Scale& scale, const Target& target,
                      base::Executor* executor, const OnProgress& on_progress, Results* results) {
  const size_t lengths = scale.lengths.size();
  std::vector<Outcome> outcomes(models.size() * lengths);
  std::vector<absl::StatusOr<SystemModel>> fitted(outcomes.size(), absl::UnknownError("not fitted"));
  const auto fit = [&](size_t model, size_t length, bool alone) -> absl::Status {
    METAEKF_ASSIGN_OR_RETURN(const Trajectory context, data::FirstSamples(target.signal, scale.lengths[length]));
    const size_t place = model * lengths + length;
    std::optional<PeakMemory> memory;
    if (alone) memory.emplace();
    const double begin = ThreadSeconds();
    fitted[place] = models[model].second(context);
    const bool too_short = absl::IsFailedPrecondition(fitted[place].status());
    outcomes[place].measured = !too_short;
    if (!fitted[place].ok()) return too_short || IsDivergence(fitted[place].status()) ? absl::OkStatus() : fitted[place].status();
    outcomes[place].seconds = ThreadSeconds() - begin;
    if (memory) outcomes[place].memory_mib = memory->MiB();
    return absl::OkStatus();
  };
  METAEKF_RETURN_IF_ERROR(RunJobs(models.size() * (lengths - 1), executor, "models adapted", on_progress,
                                  [&](size_t job) { return fit(job / (lengths - 1), job % (lengths - 1), false); }));
  METAEKF_RETURN_IF_ERROR(RunJobs(models.size(), base::CallingThread(), "models adapted to the longest context", on_progress,
                                  [&](size_t job) { return fit(job, lengths - 1, true); }));
  METAEKF_RETURN_IF_ERROR(RunJobs(outcomes.size(), executor, "models judged", on_progress, [&](size_t job) {
    return fitted[job].ok() ? Judge(*fitted[job], target.tests, &outcomes[job]) : absl::OkStatus();
  }));
  for (size_t i = 0; i < models.size(); ++i) {
    const auto first = outcomes.begin() + static_cast<std::ptrdiff_t>(i * lengths);
    results->outcomes[models[i].first].emplace_back(first, first + static_cast<std::ptrdiff_t>(lengths));
  }
  return absl::OkStatus();
}

absl::Status RunOnce(const Options& options, const Scale& scale, uint64_t run, base::Executor* executor,
                     const OnProgress& on_progress, Results* results) {
  METAEKF_ASSIGN_OR_RETURN(const Target target, MakeTarget(options, scale, run, executor));
  const std::vector<Learner> learners = Learners(options.budget);
  std::vector<std::pair<size_t, Fit>> models;
  for (const FleetKind& kind : kFleets) {
    METAEKF_ASSIGN_OR_RETURN(const sim::Fleet fleet, BoucWenFleet(scale.systems, scale.fleet_samples, kind.excitation,
                                                                  kFirstSeed + run, executor));
    METAEKF_ASSIGN_OR_RETURN(const std::vector<Training> trainings,
                             TrainAll(learners, fleet.dataset, target.signal, kFirstSeed + run, executor, on_progress));
    for (size_t i = 0; i < learners.size(); ++i) {
      const size_t index = results->IndexOf(absl::StrCat(learners[i].label, ", ", kind.label));
      results->training_s[index].push_back(trainings[i].seconds);
      results->training_mib[index].push_back(trainings[i].memory_mib);
      models.emplace_back(index, [bundle = trainings[i].bundle](const Trajectory& context) -> absl::StatusOr<SystemModel> {
        METAEKF_RETURN_IF_ERROR(bundle.status());
        return AdaptToContext(*bundle, context);
      });
    }
  }
  for (const auto& [label, like] : {std::pair{kFromScratchLabel, 0}, {kByGradientsLabel, 1}}) {
    models.emplace_back(results->IndexOf(label), [learner = learners[static_cast<size_t>(like)], run](const Trajectory& context) {
      return FitFromScratch(learner, context, kFirstSeed + run);
    });
  }
  for (const ClassicalModel& model : ClassicalModels()) models.emplace_back(results->IndexOf(model.label), model.fit);
  return JudgeAll(models, scale, target, executor, on_progress, results);
}

Table TableOf(const Results& results, const Scale& scale, const std::string& name, const std::string& title,
              const std::string& unit, bool larger_is_better, double Outcome::*quantity) {
  Table table{.name = name, .title = title, .summary = Summary::kMean, .row_heading = "model"};
  for (const int64_t length : scale.lengths) table.columns.push_back({absl::StrCat(length), unit, larger_is_better});
  for (size_t i = 0; i < results.labels.size(); ++i) {
    Row row{results.labels[i], std::vector<std::vector<double>>(scale.lengths.size())};
    for (const auto& run : results.outcomes[i]) {
      for (size_t k = 0; k < run.size(); ++k) {
        if (run[k].measured) row.cells[k].push_back(run[k].*quantity);
      }
    }
    table.rows.push_back(std::move(row));
  }
  return table;
}

Table Times(const Results& results, const Scale& scale) {
  Table table = TableOf(results, scale, "times", "Time: adaptation of a processor by samples of context, training on the wall",
                        "s", false, &Outcome::seconds);
  table.columns.push_back({"memory of the last", "MiB"});
  table.columns.push_back({"training", "s"});
  table.columns.push_back({"memory of the training", "MiB"});
  for (size_t i = 0; i < table.rows.size(); ++i) {
    std::vector<double>& memory = table.rows[i].cells.emplace_back();
    for (const auto& run : results.outcomes[i]) {
      if (run.back().measured) memory.push_back(run.back().memory_mib);
    }
    table.rows[i].cells.push_back(results.training_s[i]);
    table.rows[i].cells.push_back(results.training_mib[i]);
  }
  table.notes = {"Memory is the peak beyond what the process held before, its own code and data aside."};
  return table;
}

/// The model with the least mean error in free run after the longest context.
size_t BestModel(const Table& rmse) {
  const auto mean = [](const Row& row) { return MeanUnlessFailed(row.cells.back()); };
  return static_cast<size_t>(std::min_element(rmse.rows.begin(), rmse.rows.end(), [&](const Row& a, const Row& b) { return mean(a) < mean(b); }) -
                             rmse.rows.begin());
}

/// "Gaussian prior: 2e-05 m from the multisine fleet, 4e-05 m from the sine fleet": mean errors in free run of two rows.
std::string Compare(const Table& rmse, size_t column, const std::string& what, const std::string& row, const std::string& of_row,
                    const std::string& other_row, const std::string& of_other_row) {
  const auto mean = [&](const std::string& label) {
    const auto place = std::find_if(rmse.rows.begin(), rmse.rows.end(), [&label](const Row& one) { return one.label == label; });
    const double value = place == rmse.rows.end() ? kNan : MeanUnlessFailed(place->cells[column]);
    return std::isfinite(value) ? base::FormatShort(value, 3) + " m" : std::string("failed");
  };
  return absl::StrCat(what, ": ", mean(row), " ", of_row, ", ", mean(other_row), " ", of_other_row);
}

/// What fleet and network change, after the shortest and the longest context.
std::vector<std::string> Findings(const Table& rmse, const std::string& printed_label) {
  std::vector<std::string> findings;
  for (const size_t column : {size_t{0}, rmse.columns.size() - 1}) {
    const auto of_fleets = [&](const std::string& learner) {
      return Compare(rmse, column, learner, learner + ", multisine fleet", "from the multisine fleet", learner + ", sine fleet",
                     "from the sine fleet");
    };
    const std::string after = absl::StrCat(" after ", rmse.columns[column].name, " samples. ");
    findings.push_back(absl::StrCat("What the fleet changes", after, of_fleets("Gaussian prior"), "; ", of_fleets("MAML"), "."));
    findings.push_back(absl::StrCat("What the network changes", after,
                                    Compare(rmse, column, "MAML", "MAML, multisine fleet", "with the small network",
                                            printed_label + ", multisine fleet", "with the printed one"), "."));
  }
  return findings;
}

absl::StatusOr<Picture> DrawPrediction(const std::string& label, const Outcome& outcome, const Trajectory& test) {
  constexpr Eigen::Index kShown = 750;  // one second
  const Eigen::Index shown = std::min<Eigen::Index>(kShown, outcome.free.cols());
  plot::Series truth{.label = "true", .colour = plot::Colour::kBlack};
  plot::Series predicted{.label = label, .mark = plot::Mark::kDashes, .colour = plot::Colour::kVermilion};
  plot::Series error{.colour = plot::Colour::kBlue};
  for (Eigen::Index t = 0; t < shown; ++t) {
    const double time = static_cast<double>(t + kScoredFrom) * test.sample_period_s;
    const double y = test.outputs(0, t + kScoredFrom), y_hat = outcome.free(0, t);
    for (plot::Series* series : {&truth, &predicted, &error}) series->x.push_back(time);
    truth.y.push_back(1e3 * y);
    predicted.y.push_back(1e3 * y_hat);
    error.y.push_back(1e3 * (y_hat - y));
  }
  METAEKF_ASSIGN_OR_RETURN(
      std::string svg, plot::RenderSvg({.title = "Free run on an unseen multisine", .x_label = "t (s)",
                                        .panels = {{.y_label = "displacement (mm)", .series = {truth, predicted}},
                                                   {.y_label = "error (mm)", .series = {error}}}}));
  return Picture{"bouc-wen-performance", std::move(svg)};
}

/// Errors in free run over the first test, after the longest context, of the best model and of some others.
absl::StatusOr<Picture> DrawErrors(const Results& results, size_t best, const Trajectory& test) {
  plot::BoxPlot picture{.title = "Errors in free run on an unseen multisine", .x_label = "error (mm)"};
  std::vector<std::string> labels = {results.labels[best]};
  for (const char* other : {"Gaussian prior, multisine fleet", "MAML, multisine fleet", "Xfer, multisine fleet", kFromScratchLabel, "ARX(5)"}) {
    if (labels[0] != other) labels.emplace_back(other);
  }
  for (const std::string& label : labels) {
    const auto place = std::find(results.labels.begin(), results.labels.end(), label);
    if (place == results.labels.end()) continue;
    const Outcome& outcome = results.outcomes[static_cast<size_t>(place - results.labels.begin())][0].back();
    const bool failed = !std::isfinite(outcome.free_rmse);
    plot::Box box{.label = failed ? label + " (failed)" : label};
    for (Eigen::Index t = 0; t < outcome.free.cols() && !failed; ++t) {
      box.values.push_back(1e3 * (outcome.free(0, t) - test.outputs(0, t + kScoredFrom)));
    }
    picture.boxes.push_back(std::move(box));
  }
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg(picture));
  return Picture{"error-distribution", std::move(svg)};
}

/// Displacement against force over a second, one period, of every system of the fleet as printed.
absl::StatusOr<Picture> DrawLoops(const Scale& scale, base::Executor* executor) {
  METAEKF_ASSIGN_OR_RETURN(const sim::Fleet fleet,
                           BoucWenFleet(scale.systems, std::min(scale.fleet_samples, kPeriodSamples + 1), BoucWenExcitation::kSine,
                                        kFirstSeed, executor));
  plot::Panel panel{.y_label = "displacement (mm)"};
  for (const Trajectory& system : fleet.dataset.trajectories) {
    plot::Series loop;
    for (Eigen::Index t = 0; t < system.length(); ++t) {
      loop.x.push_back(system.inputs(0, t));
      loop.y.push_back(1e3 * system.outputs(0, t));
    }
    panel.series.push_back(std::move(loop));
  }
  METAEKF_ASSIGN_OR_RETURN(std::string svg,
                           plot::RenderSvg({.title = "Hysteresis loops of the fleet", .x_label = "force (N)",
                                            .panels = {std::move(panel)}, .width_px = 700, .panel_height_px = 420}));
  return Picture{"hysteresis-loops", std::move(svg)};
}

absl::StatusOr<Report> Run(const Options& options, base::Executor* executor, const OnProgress& on_progress) {
  const Scale scale = ScaleOf(options);
  if (scale.lengths.empty()) {
    return absl::InvalidArgumentError(absl::StrCat("the recording has ", options.recording->length(),
                                                   " samples; the shortest context is longer"));
  }
  Results results;
  for (int run = 0; run < scale.runs; ++run) {
    METAEKF_RETURN_IF_ERROR(RunOnce(options, scale, static_cast<uint64_t>(run), executor, on_progress, &results));
  }
  const std::string signal = options.recording ? "the measured estimation signal" : "a simulated stand-in of the estimation signal";
  Report report;
  report.tables = {
      TableOf(results, scale, "free_run_rmse", "Free run, RMSE by samples of context, of " + signal, "m", false, &Outcome::free_rmse),
      TableOf(results, scale, "free_run_fit", "Free run, Fit by samples of context", "%", true, &Outcome::free_fit),
      TableOf(results, scale, "one_step_rmse", "One step ahead, RMSE by samples of context", "m", false, &Outcome::one_step_rmse),
      TableOf(results, scale, "one_step_fit", "One step ahead, Fit by samples of context", "%", true, &Outcome::one_step_fit),
      Times(results, scale)};
  report.tables[0].notes = {
      "Tests are multisines of the nominal system with fresh phases, without noise; mean ± standard deviation over runs.",
      "From scratch with 20 and 80 % of the signal, 8192 and 32768 samples: the paper's Sup/Tr20 and Sup/Tr80.",
      "Univ is trained with the longest context. The printed network has a fraction of the paper's 10,000 epochs: not converged."};
  const size_t best = BestModel(report.tables[0]);
  report.findings = {absl::StrCat("Best in free run after ", scale.lengths.back(), " samples: ", results.labels[best], " with ",
                                  base::FormatShort(Summarise(report.tables[0].rows[best].cells.back(), false).mean, 3), " m.")};
  for (std::string& finding : Findings(report.tables[0], PrintedMaml(options.budget).label)) {
    report.findings.push_back(std::move(finding));
  }
  METAEKF_ASSIGN_OR_RETURN(const Target target, MakeTarget(options, scale, 0, executor));
  METAEKF_ASSIGN_OR_RETURN(Picture performance,
                           DrawPrediction(results.labels[best], results.outcomes[best][0].back(), target.tests[0]));
  METAEKF_ASSIGN_OR_RETURN(Picture errors, DrawErrors(results, best, target.tests[0]));
  METAEKF_ASSIGN_OR_RETURN(Picture loops, DrawLoops(scale, executor));
  report.pictures = {std::move(performance), std::move(errors), std::move(loops)};
  return report;
}

}  // namespace

Experiment BoucWenTables() {
  return {"bouc-wen-tables", "the paper's tables of the Bouc–Wen benchmark, in free run as well", Protocol, Run};
}

}  // namespace metaekf::experiments
