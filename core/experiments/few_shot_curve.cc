#include <algorithm>
#include <cmath>
#include <limits>

#include "absl/strings/str_join.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/data/split.h"
#include "core/experiments/bouc_wen_data.h"
#include "core/experiments/bouc_wen_learners.h"
#include "core/experiments/classical.h"
#include "core/experiments/jobs.h"
#include "core/experiments/learner.h"
#include "core/experiments/studies.h"
#include "core/plot/svg.h"

namespace metaekf::experiments {
namespace {

using data::Trajectory;
using nlohmann::json;

constexpr uint64_t kFirstSeed = 1;        // of the fleet and of training; protocols were chosen with other seeds
constexpr uint64_t kTargetSeed = 777001;  // of the targets
constexpr int kManifoldRank = 10;
constexpr int64_t kScoredFrom = 64;       // of a test: beyond the warm-up of every model
constexpr double kFailedFit = -1000;       // %: an error of eleven times the signal, and beyond it a failure whatever its size
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

struct Scale {
  int64_t targets, systems, fleet_samples, test_samples;
  std::vector<int64_t> lengths;
};

Scale ScaleOf(const Options& options) {
  Scale scale = options.budget == Budget::kFull    ? Scale{100, 60, 4096, 4096, {100, 200, 300, 500, 800, 2048, 8192}}
                : options.budget == Budget::kQuick ? Scale{8, 40, 2048, 4096, {100, 200, 300, 500, 800, 2048}}
                                                   : Scale{2, 4, 300, 200, {120, 200}};
  if (options.seeds) scale.targets = *options.seeds;
  return scale;
}

/// Medians of a rival that learns a manifold of parameters over the same family, as published; their family and test
/// signals are not quite ours.
struct Published {
  int64_t length;
  double fit_percent;
};
constexpr Published kManifold[] = {{100, 86.0}, {200, 92.7}, {300, 94.4}, {500, 95.0}, {800, 95.4}};

std::vector<ClassicalModel> ClassicalModels() { return {Arx(5), OutputError(5), PolynomialNarx(3, 3)}; }

/// Those of the fleet, and the prior of few factors: what the published rival learns.
std::vector<Learner> Learners(Budget budget) {
  std::vector<Learner> learners = BoucWenLearners(budget);
  Learner manifold = learners.front();  // the Gaussian prior
  manifold.label = absl::StrCat("Manifold of ", kManifoldRank, " factors");
  manifold.specification["gaussian_prior"]["covariance"] = "MANIFOLD";
  manifold.specification["gaussian_prior"]["rank"] = kManifoldRank;
  learners.insert(learners.begin() + 1, std::move(manifold));
  return learners;
}

json Protocol(const Options& options) {
  const Scale scale = ScaleOf(options);
  json learners = json::array(), classical = json::array();
  for (const Learner& learner : Learners(options.budget)) learners.push_back(ToJson(learner));
  for (const ClassicalModel& model : ClassicalModels()) classical.push_back(model.label);
  return {{"experiment", "few-shot-curve"},
          {"targets", scale.targets},
          {"first_seed", kFirstSeed},
          {"target_seed", kTargetSeed},
          {"fleet", {{"systems", scale.systems}, {"samples", scale.fleet_samples}, {"excitation", "multisine"}}},
          {"noise_std_m", kBoucWenNoiseM},
          {"context_samples", scale.lengths},
          {"test", {{"samples", scale.test_samples}, {"scored_from", kScoredFrom}, {"noise_std_m", 0}}},
          {"learners", learners},
          {"from_scratch", kFromScratchLabel},
          {"classical", classical}};
}

/// Fit in free run of one model of one target; nothing where there is no such model of so few samples.
absl::StatusOr<std::vector<double>> Judge(const absl::StatusOr<SystemModel>& model, const Trajectory& test) {
  if (absl::IsFailedPrecondition(model.status())) return std::vector<double>();
  if (IsDivergence(model.status())) return std::vector<double>{kNan};
  METAEKF_RETURN_IF_ERROR(model.status());
  METAEKF_ASSIGN_OR_RETURN(const Eigen::MatrixXd free, PredictFreely(*model, test, kScoredFrom));
  const Eigen::MatrixXd truth = test.outputs.rightCols(free.cols());
  const double fit = nssm::ScorePredictions({truth}, {free}).fit_percent[0];
  return std::vector<double>{fit > kFailedFit ? fit : kNan};
}

struct Study {
  Scale scale;
  std::vector<Learner> learners;
  std::vector<ClassicalModel> classical;
  std::vector<Training> trainings;  // of the learners
  BoucWenTargets targets;

  /// Learners, then the model from scratch, then the classical ones.
  std::vector<std::string> Labels() const {
    std::vector<std::string> labels;
    for (const Learner& learner : learners) labels.push_back(learner.label);
    labels.push_back(kFromScratchLabel);
    for (const ClassicalModel& model : classical) labels.push_back(model.label);
    return labels;
  }

  absl::StatusOr<SystemModel> Fit(size_t model, const Trajectory& context) const {
    if (model < learners.size()) {
      METAEKF_RETURN_IF_ERROR(trainings[model].bundle.status());
      return AdaptToContext(*trainings[model].bundle, context);
    }
    if (model == learners.size()) return FitFromScratch(learners[0], context, kFirstSeed);
    return classical[model - learners.size() - 1].fit(context);
  }
};

/// Values of every target, by model and length.
using Fits = std::vector<std::vector<std::vector<std::vector<double>>>>;

Table ToTable(const Study& study, const Fits& fits) {
  Table table{.name = "fit",
              .title = absl::StrCat("Fit in free run (%) against samples of context; median [quartiles] of ",
                                    study.scale.targets, " targets"),
              .row_heading = "model"};
  for (const int64_t length : study.scale.lengths) table.columns.push_back({absl::StrCat(length), "%", true});
  const std::vector<std::string> labels = study.Labels();
  for (size_t model = 0; model < labels.size(); ++model) {
    Row row{labels[model], {}};
    for (const auto& of_length : fits[model]) {
      row.cells.emplace_back();
      for (const auto& value : of_length) row.cells.back().insert(row.cells.back().end(), value.begin(), value.end());
    }
    table.rows.push_back(std::move(row));
  }
  Row published{"manifold (published median)", std::vector<std::vector<double>>(study.scale.lengths.size())};
  for (const Published& one : kManifold) {
    const auto place = std::find(study.scale.lengths.begin(), study.scale.lengths.end(), one.length);
    if (place == study.scale.lengths.end()) continue;
    published.cells[static_cast<size_t>(place - study.scale.lengths.begin())] = {one.fit_percent};
  }
  table.rows.push_back(std::move(published));
  table.notes = {"Contexts are noisy; tests are other multisines without noise. An empty cell: too few samples for the model."};
  return table;
}

std::vector<std::string> Findings(const Table& table) {
  std::vector<std::string> parts;
  for (size_t i = 0; i < table.columns.size(); ++i) {
    const Row* best = nullptr;
    double best_median = -std::numeric_limits<double>::infinity();
    for (size_t r = 0; r + 1 < table.rows.size(); ++r) {  // the last is not ours
      const double median = Summarise(table.rows[r].cells[i], true).median;
      if (median > best_median) {
        best_median = median;
        best = &table.rows[r];
      }
    }
    if (best == nullptr) continue;
    parts.push_back(absl::StrCat(best->label, " at ", table.columns[i].name, " (", base::FormatShort(best_median, 3), " %)"));
  }
  return {absl::StrCat("Best median: ", absl::StrJoin(parts, ", "), ".")};
}

/// What is left unexplained, for differences between 99 and 99.9 % to be seen. As many models as there are colours: the others
/// by gradient steps lie about MAML, and all are in the table.
absl::StatusOr<Picture> Draw(const Study& study, const Table& table) {
  const std::vector<std::string> left_out = {"FO-MAML", "ANIL", "Reptile", "iMAML", "OE(5)", "NARX(3), degree 3"};
  plot::Panel panel{.y_label = "100 − Fit (%)", .logarithmic_y = true};
  for (size_t r = 0; r < table.rows.size(); ++r) {
    const Row& row = table.rows[r];
    if (std::find(left_out.begin(), left_out.end(), row.label) != left_out.end()) continue;
    const bool ours = r < study.learners.size();
    plot::Series series{.label = row.label, .mark = ours ? plot::Mark::kLine : plot::Mark::kDashes};
    plot::Band band{};
    for (size_t i = 0; i < row.cells.size(); ++i) {
      if (row.cells[i].empty()) continue;
      const Statistics s = Summarise(row.cells[i], true);
      series.x.push_back(static_cast<double>(study.scale.lengths[i]));
      series.y.push_back(100 - s.median);
      band.lower.push_back(100 - s.upper_quartile);
      band.upper.push_back(100 - s.lower_quartile);
    }
    band.x = series.x;
    if (ours) panel.bands.push_back(std::move(band));
    if (r + 1 == table.rows.size()) {
      series.colour = plot::Colour::kBlack;
      series.mark = plot::Mark::kPoints;
    }
    panel.series.push_back(std::move(series));
  }
  METAEKF_ASSIGN_OR_RETURN(std::string svg,
                           plot::RenderSvg({.title = "What the models of a new system leave unexplained",
                                            .x_label = "samples of context", .logarithmic_x = true,
                                            .panels = {std::move(panel)}, .panel_height_px = 380}));
  return Picture{"few-shot-curve", std::move(svg)};
}

absl::StatusOr<Report> Run(const Options& options, base::Executor* executor, const OnProgress& on_progress) {
  Study study{.scale = ScaleOf(options), .learners = Learners(options.budget), .classical = ClassicalModels()};
  METAEKF_ASSIGN_OR_RETURN(const sim::Fleet fleet,
                           BoucWenFleet(study.scale.systems, study.scale.fleet_samples, BoucWenExcitation::kMultisine,
                                        kFirstSeed, executor));
  METAEKF_ASSIGN_OR_RETURN(study.targets, RandomBoucWenTargets(study.scale.targets, study.scale.lengths.back(),
                                                               study.scale.test_samples, kTargetSeed, executor));
  METAEKF_ASSIGN_OR_RETURN(study.trainings, TrainAll(study.learners, fleet.dataset, {}, kFirstSeed, executor, on_progress));

  const std::vector<std::string> labels = study.Labels();
  const size_t models = labels.size(), targets = study.targets.contexts.size();
  Fits fits(models, {study.scale.lengths.size(), std::vector<std::vector<double>>(targets)});
  std::vector<std::vector<double>> adaptation_s(models, std::vector<double>(targets));
  const auto judge = [&](size_t job) -> absl::Status {
    const size_t target = job / models, model = job % models;
    const double begin = ThreadSeconds();
    for (size_t i = 0; i < study.scale.lengths.size(); ++i) {
      METAEKF_ASSIGN_OR_RETURN(const Trajectory context,
                               data::FirstSamples(study.targets.contexts[target], study.scale.lengths[i]));
      METAEKF_ASSIGN_OR_RETURN(fits[model][i][target], Judge(study.Fit(model, context), study.targets.tests[target]));
    }
    adaptation_s[model][target] = ThreadSeconds() - begin;
    return absl::OkStatus();
  };
  METAEKF_RETURN_IF_ERROR(RunJobs(models * targets, executor, "adaptations", on_progress, judge));
  Table times{.name = "times", .title = "Time: training on the wall, adaptation and test of one target at all lengths of a processor",
              .row_heading = "model", .columns = {{"training", "s"}, {"memory of the training", "MiB"}, {"one target", "s"}}};
  for (size_t model = 0; model < models; ++model) {
    times.rows.push_back({labels[model], {{}, {}, adaptation_s[model]}});
    if (model >= study.trainings.size()) continue;
    times.rows.back().cells[0] = {study.trainings[model].seconds};
    times.rows.back().cells[1] = {study.trainings[model].memory_mib};
  }
  Table table = ToTable(study, fits);
  METAEKF_ASSIGN_OR_RETURN(Picture picture, Draw(study, table));
  std::vector<std::string> findings = Findings(table);
  return Report{{std::move(table), std::move(times)}, std::move(findings), {std::move(picture)}};
}

}  // namespace

Experiment FewShotCurve() {
  return {"few-shot-curve", "Fit in free run of Bouc–Wen oscillators against samples of context", Protocol, Run};
}

}  // namespace metaekf::experiments
