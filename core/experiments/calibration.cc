#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/base/rng.h"
#include "core/base/status.h"
#include "core/experiments/bouc_wen_learners.h"
#include "core/experiments/filter_run.h"
#include "core/experiments/jobs.h"
#include "core/experiments/localization_data.h"
#include "core/experiments/localization_learners.h"
#include "core/experiments/studies.h"
#include "core/experiments/vapor_compression_learners.h"
#include "core/plot/svg.h"
#include "core/sim/simulate.h"

namespace metaekf::experiments {
namespace {

using data::Trajectory;
using Eigen::Index;
using Eigen::MatrixXd;
using filter::Health;
using nlohmann::json;

constexpr uint64_t kFirstSeed = 1;          // of the fleets; what was chosen was chosen on seeds from 1000 on
constexpr uint64_t kTargetSeeds = 1 << 20;  // added: targets are no systems of the fleet
constexpr int kResamples = 2000;
constexpr double kPoor = 85;  // %: a figure of a target's own that its health should tell
constexpr int kDraws = 100;   // of errors as a filter believes them, for what chance alone does to a target's own figure
constexpr double kTold = 5;   // %: of the samples that health calls overconfident or diverged, more than chance
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

/// Nominal shares and the widths in standard deviations that hold them.
constexpr std::array<std::pair<double, double>, 5> kLevels = {{{50, 0.674490}, {80, 1.281552}, {90, 1.644854}, {95, 1.959964}, {99, 2.575829}}};
constexpr size_t k95 = 3;

/// A family of systems, how models of it are learned, and what they are judged on.
struct Subject {
  std::string name;
  Learner learner;
  sim::Request fleet, targets;
  int64_t context;
};

/// The recipe of deploy/specs/van-der-pol.textproto.
constexpr char kVanDerPol[] = R"json({
  "algorithm": "GAUSSIAN_PRIOR",
  "model": {
    "case": "STATE_INPUT_OUTPUT", "latent_size": 2, "precision": "FLOAT64",
    "transition": {"form": "AUTONOMOUS", "bypass": "SKIP", "block": {"hidden_widths": [16], "activation": "TANH", "output_scale": 0.01}}
  },
  "loss": {"horizon": 50, "stride": 100, "rollout": "STATE"},
  "gaussian_prior": {"restarts": 3, "rounds": 2, "first_steps": 25, "round_steps": 6},
  "context_samples": 400, "target_samples": 600, "validation_share": 0.2, "adaptation": {"steps": 0}
})json";
constexpr char kTinyVanDerPol[] = R"json({
  "context_samples": 120, "target_samples": 120, "gaussian_prior": {"restarts": 1, "rounds": 1, "first_steps": 4, "round_steps": 2}
})json";

const Learner& Named(const std::vector<Learner>& learners, const std::string& label) {
  return *std::find_if(learners.begin(), learners.end(), [&label](const Learner& learner) { return learner.label == label; });
}

std::vector<Subject> Subjects(const Options& options) {
  const Budget budget = options.budget;
  const auto pick = [budget](int64_t full, int64_t quick, int64_t tiny) {
    return budget == Budget::kFull ? full : budget == Budget::kQuick ? quick : tiny;
  };
  const int64_t hundred = pick(100, 20, 2), cheap = pick(400, 20, 2);  // targets
  std::vector<Subject> subjects;
  const auto add = [&](const std::string& name, Learner learner, const std::string& system, std::map<std::string, std::string> settings,
                       int64_t sources, int64_t targets, int64_t fleet_samples, int64_t context, int64_t samples) {
    learner.label = name;
    subjects.push_back({name, std::move(learner),
                        {.system = system, .systems = sources, .seed = kFirstSeed, .steps = fleet_samples, .settings = settings},
                        {.system = system, .systems = targets, .seed = kFirstSeed + kTargetSeeds, .steps = context + samples, .settings = settings},
                        context});
  };
  Learner oscillator{.data = TrainingData::kFleet, .specification = json::parse(kVanDerPol)};
  if (budget == Budget::kTiny) oscillator.specification.merge_patch(json::parse(kTinyVanDerPol));
  add("van der Pol", oscillator, "van-der-pol", {{"noise_std", "0.005"}}, pick(300, 40, 6), hundred, pick(2000, 1000, 160), pick(400, 400, 120), pick(3000, 1500, 60));
  Learner hysteretic = BoucWenLearners(budget).front();
  hysteretic.specification["validation_share"] = 0.2;  // a tenth of a fleet says little about bounds
  add("Bouc–Wen", hysteretic, "bouc-wen", {{"noise_std", "7.5e-6"}}, pick(80, 12, 4), hundred, pick(10000, 2048, 300), pick(500, 500, 120), pick(1500, 1500, 60));
  subjects.back().targets.settings["states"] = "1";  // y without noise is one of them
  const auto vehicles = LocalizationData()["settings"].get<std::map<std::string, std::string>>();
  for (const char* label : {kMamlSwish, kPriorSwish}) {
    add(absl::StrCat("localization, ", label), Named(LocalizationLearners(budget), label), "magnetic-localization", vehicles, pick(400, 40, 5), cheap, kLocalizationSamples, kLocalizationContext, kLocalizationSamples - kLocalizationContext);
  }
  add("vapor compression", Named(VaporCompressionLearners(budget), kVaporPrior), "vapor-compression",
      VaporCompressionSettings(), pick(100, 20, 5), hundred, pick(3000, 1500, 120), pick(200, 200, 60), pick(1500, 600, 60));
  return subjects;
}

json ToJson(const sim::Request& request) {
  return {{"system", request.system}, {"systems", request.systems}, {"seed", request.seed}, {"samples", *request.steps}, {"settings", request.settings}};
}

json Protocol(const Options& options) {
  json subjects = json::array(), learners = json::array();
  for (const Subject& subject : Subjects(options)) {
    subjects.push_back({{"name", subject.name}, {"fleet", ToJson(subject.fleet)}, {"targets", ToJson(subject.targets)}, {"context_samples", subject.context}});
    learners.push_back(ToJson(subject.learner));
  }
  return {{"experiment", "calibration"}, {"first_seed", kFirstSeed}, {"subjects", subjects}, {"learners", learners}};
}

/// Of one target: shares in %.
struct Trial {
  bool failed = true;
  std::array<double, kLevels.size()> held{};
  double nis = kNaN;  // per measured output
  std::array<double, 5> health{};
  // Were the filter right about its errors (CoverageByChance): the least of kDraws figures, and the share of them below kPoor.
  double least_by_chance = kNaN, poor_by_chance = kNaN;

  bool is_poor() const { return !failed && held[k95] < kPoor; }
  /// Beyond what chance does.
  bool is_off() const { return is_poor() && held[k95] < least_by_chance; }
  bool is_told() const { return health[static_cast<size_t>(Health::kOverconfident)] + health[static_cast<size_t>(Health::kDiverged)] >= kTold; }
};

struct Result {
  Subject subject;
  Training training;
  std::vector<Trial> trials;

  /// Mean over targets that have not failed.
  double Pooled(size_t level) const {
    double sum = 0, count = 0;
    for (const Trial& trial : trials) {
      if (!trial.failed) sum += trial.held[level], ++count;
    }
    return sum / count;
  }
  template <typename Quantity>
  std::vector<double> Values(const Quantity& quantity) const {
    std::vector<double> values;
    for (const Trial& trial : trials) {
      if (!trial.failed) values.push_back(quantity(trial));
    }
    return values;
  }
};

/// 95 % of what the pooled figure is over resampled targets: all samples of a target stay together.
std::pair<double, double> BootstrapInterval(const std::vector<double>& of_targets) {
  if (of_targets.empty()) return {kNaN, kNaN};
  base::Rng rng(kFirstSeed);
  std::vector<double> means;
  for (int resample = 0; resample < kResamples; ++resample) {
    double sum = 0;
    for (size_t i = 0; i < of_targets.size(); ++i) sum += of_targets[rng.Index(of_targets.size())];
    means.push_back(sum / static_cast<double>(of_targets.size()));
  }
  std::sort(means.begin(), means.end());
  return {means[static_cast<size_t>(0.025 * kResamples)], means[static_cast<size_t>(0.975 * kResamples)]};
}

absl::StatusOr<Trial> RunTrial(const Subject& subject, const nssm::Bundle& model, const std::shared_ptr<const filter::FilterModel>& functions,
                               const Trajectory& recording, uint64_t target) {
  const bool case_one = model.model.spec().is_case_one();
  Trajectory measured = recording;
  if (case_one) measured.states.resize(0, measured.length());
  const absl::StatusOr<nssm::Bundle> adapted = AdaptForFilter(model, measured, subject.context);
  if (IsDivergence(adapted.status())) return Trial();
  METAEKF_RETURN_IF_ERROR(adapted.status());
  METAEKF_ASSIGN_OR_RETURN(const FilterRun run, FilterAfterContext(*adapted, functions, measured, subject.context));
  const MatrixXd truth = recording.states.topRows(run.means.rows()).rightCols(run.means.cols());
  const MatrixXd errors = run.means - truth;  // headings are never wrapped: the simulator's go on from round to round
  Trial trial{.failed = false};
  for (size_t level = 0; level < kLevels.size(); ++level) trial.held[level] = 100 * Coverage(run, errors, kLevels[level].second);
  trial.nis = run.nis.mean() / static_cast<double>(recording.outputs.rows());
  for (const Health health : run.health) trial.health[static_cast<size_t>(health)] += 100.0 / static_cast<double>(run.health.size());
  METAEKF_ASSIGN_OR_RETURN(const std::vector<double> by_chance, CoverageByChance(*adapted, functions, measured, subject.context, kLevels[k95].second, kDraws, base::Rng(kFirstSeed, target)));
  trial.least_by_chance = 100 * *std::min_element(by_chance.begin(), by_chance.end());
  trial.poor_by_chance = static_cast<double>(std::count_if(by_chance.begin(), by_chance.end(), [](double held) { return 100 * held < kPoor; })) / kDraws;
  return trial;
}

Table Pooled(const std::vector<Result>& results) {
  Table table{.name = "coverage", .title = "Truth within bounds of 95 %, pooled over targets; interval by resampling targets", .row_heading = "systems",
              .columns = {{"targets"}, {"failed"}, {"held", "%"}, {"from", "%"}, {"to", "%"}}};
  for (const Result& result : results) {
    const auto own = result.Values([](const Trial& trial) { return trial.held[k95]; });
    const auto [from, to] = BootstrapInterval(own);
    table.rows.push_back({result.subject.name, {{static_cast<double>(result.trials.size())}, {static_cast<double>(result.trials.size() - own.size())}, {result.Pooled(k95)}, {from}, {to}}});
  }
  return table;
}

Table OfTargets(const std::vector<Result>& results) {
  Table table{.name = "targets", .title = "Of each target: truth within bounds of 95 %, NIS, and samples by what health said; median [quartiles]", .row_heading = "systems",
              .columns = {{"held", "%"}, {"NIS per output"}, {"consistent", "%"}, {"overconfident", "%"}, {"underconfident", "%"}, {"diverged", "%"}}};
  for (const Result& result : results) {
    const auto health = [&](Health word) { return result.Values([word](const Trial& trial) { return trial.health[static_cast<size_t>(word)]; }); };
    table.rows.push_back({result.subject.name,
                          {result.Values([](const Trial& trial) { return trial.held[k95]; }), result.Values([](const Trial& trial) { return trial.nis; }),
                           health(Health::kConsistent), health(Health::kOverconfident), health(Health::kUnderconfident), health(Health::kDiverged)}});
  }
  return table;
}

std::vector<std::string> Findings(const std::vector<Result>& results) {
  std::vector<std::string> findings;
  for (const Result& result : results) {
    int poor = 0, poor_told = 0, off = 0, off_told = 0, alarms = 0;
    double by_chance = 0;
    for (const Trial& trial : result.trials) {
      if (trial.failed) continue;
      poor += trial.is_poor() ? 1 : 0;
      poor_told += trial.is_poor() && trial.is_told() ? 1 : 0;
      off += trial.is_off() ? 1 : 0;
      off_told += trial.is_off() && trial.is_told() ? 1 : 0;
      alarms += !trial.is_poor() && trial.is_told() ? 1 : 0;
      by_chance += trial.poor_by_chance;
    }
    findings.push_back(absl::StrCat(result.subject.name, ": ", base::FormatShort(result.Pooled(k95), 3), " % within bounds of 95 %; ", poor, " of ", result.trials.size(),
                                    " targets below ", kPoor, " %, where filters that are right about their errors have ", base::FormatShort(by_chance, 2), " by chance; health called ", poor_told,
                                    " of them overconfident or diverged for ", kTold, " % of the time at least, ", off_told, " of the ", off, " that are lower than in each of ", kDraws,
                                    " draws of such errors, and ", alarms, " of the other targets."));
  }
  return findings;
}

absl::StatusOr<Picture> DrawReliability(const std::vector<Result>& results) {
  plot::Panel panel{.y_label = "truth within (%)"};
  for (const Result& result : results) {
    plot::Series series{.label = result.subject.name};
    for (size_t level = 0; level < kLevels.size(); ++level) {
      series.x.push_back(kLevels[level].first);
      series.y.push_back(result.Pooled(level));
    }
    panel.series.push_back(std::move(series));
  }
  panel.series.push_back({.label = "as it should be", .x = {50, 99}, .y = {50, 99}, .mark = plot::Mark::kDashes, .colour = plot::Colour::kBlack});
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg({.title = "Bounds and what they hold, pooled over targets", .x_label = "nominal share (%)",
                                                             .panels = {std::move(panel)}, .panel_height_px = 320}));
  return Picture{"reliability", std::move(svg)};
}

absl::StatusOr<Picture> DrawTargets(const std::vector<Result>& results) {
  plot::Figure figure{.title = "Every target: what its bounds of 95 % hold, and how often health complained", .x_label = "samples called over- or underconfident or diverged (%)", .panel_height_px = 150};
  for (const Result& result : results) {
    plot::Series series{.mark = plot::Mark::kPoints};
    for (const Trial& trial : result.trials) {
      if (trial.failed) continue;
      series.x.push_back(100 - trial.health[static_cast<size_t>(Health::kConsistent)] - trial.health[static_cast<size_t>(Health::kWarmingUp)]);
      series.y.push_back(trial.held[k95]);
    }
    figure.panels.push_back({.title = result.subject.name, .y_label = "held (%)", .series = {std::move(series)}});
  }
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg(figure));
  return Picture{"targets", std::move(svg)};
}

absl::StatusOr<Result> Judge(const Subject& subject, base::Executor* executor, const OnProgress& on_progress) {
  METAEKF_ASSIGN_OR_RETURN(const sim::Fleet fleet, SimulateFleet(subject.fleet, executor, absl::StrCat("simulating the fleet of ", subject.name), on_progress));
  METAEKF_ASSIGN_OR_RETURN(const sim::Fleet targets, SimulateFleet(subject.targets, executor, absl::StrCat("simulating targets of ", subject.name), on_progress));
  METAEKF_ASSIGN_OR_RETURN(std::vector<Training> trainings, TrainAll({subject.learner}, fleet.dataset, {}, kFirstSeed, executor, on_progress));
  Result result{subject, std::move(trainings.front()), std::vector<Trial>(targets.dataset.trajectories.size())};
  if (!result.training.bundle.ok()) return result;
  const nssm::Bundle& model = *result.training.bundle;
  const std::shared_ptr<const filter::FilterModel> functions = filter::FilterModel::Create(model);
  METAEKF_RETURN_IF_ERROR(RunJobs(result.trials.size(), executor, absl::StrCat("targets of ", subject.name), on_progress, [&](size_t target) -> absl::Status {
    METAEKF_ASSIGN_OR_RETURN(result.trials[target], RunTrial(subject, model, functions, targets.dataset.trajectories[target], target));
    return absl::OkStatus();
  }));
  return result;
}

absl::StatusOr<Report> Run(const Options& options, base::Executor* executor, const OnProgress& on_progress) {
  std::vector<Result> results;
  for (const Subject& subject : Subjects(options)) {
    METAEKF_ASSIGN_OR_RETURN(Result result, Judge(subject, executor, on_progress));
    results.push_back(std::move(result));
  }
  METAEKF_ASSIGN_OR_RETURN(Picture reliability, DrawReliability(results));
  METAEKF_ASSIGN_OR_RETURN(Picture targets, DrawTargets(results));
  return Report{{Pooled(results), OfTargets(results)}, Findings(results), {std::move(reliability), std::move(targets)}};
}

}  // namespace

Experiment Calibration() {
  return {"calibration", "what the filters' bounds hold, on every system, with adapted models and the Q and R they found", Protocol, Run};
}

}  // namespace metaekf::experiments
