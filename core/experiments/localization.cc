#include <algorithm>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>
#include <numbers>
#include <optional>

#include "core/autodiff/activation.h"
#include "core/base/numbers.h"
#include "core/base/rng.h"
#include "core/base/status.h"
#include "core/experiments/filter_run.h"
#include "core/experiments/jobs.h"
#include "core/experiments/localization_data.h"
#include "core/experiments/localization_learners.h"
#include "core/experiments/studies.h"
#include "core/plot/box_plot.h"
#include "core/plot/field_maps.h"
#include "core/plot/svg.h"

namespace metaekf::experiments {
namespace {

using data::Trajectory;
using Eigen::Index;
using Eigen::MatrixXd;
using nlohmann::json;

constexpr uint64_t kFirstSeed = 1;          // of the runs; what was chosen was chosen on seeds from 1000 on
constexpr uint64_t kTargetSeeds = 1 << 20;  // added: targets are no vehicles of the fleet
constexpr double kWidth95 = 1.959964;
constexpr double kInfinity = std::numeric_limits<double>::infinity();

struct Scale {
  int64_t sources, targets;  // of each run
  int cells;
  int runs;
};

Scale ScaleOf(const Options& options) {
  Scale scale = options.budget == Budget::kTiny ? Scale{5, 2, 12, 1} : Scale{80, 20, 200, 1};
  if (options.seeds) scale.runs = *options.seeds;
  return scale;
}

json Protocol(const Options& options) {
  const Scale scale = ScaleOf(options);
  json learners = json::array();
  for (const Learner& learner : LocalizationLearners(options.budget)) learners.push_back(ToJson(learner));
  return {{"experiment", "localization"}, {"runs", scale.runs},       {"first_seed", kFirstSeed},
          {"target_seed", absl::StrCat("seed + ", kTargetSeeds)},     {"sources", scale.sources},
          {"targets", scale.targets},     {"data", LocalizationData()}, {"grid_cells", scale.cells},
          {"learners", learners}};
}

/// What a model of one target has achieved; infinite where it diverged.
struct Trial {
  double adapted = kInfinity, unadapted = kInfinity, free_run = kInfinity;  // Σ ‖x̂ − x‖
  double coverage = 0;           // of 95 % bounds, adapted
  double adaptation_s = kInfinity, step_s = kInfinity;
  FilterRun run;
};

struct Study {
  Scale scale;
  std::vector<Learner> learners;
  std::vector<std::vector<Training>> trainings;   // by run and learner
  std::vector<sim::Fleet> targets;                // by run
  std::vector<std::vector<Trial>> trials;         // by learner and target, those of one run behind those of the other
  std::vector<std::optional<FieldGrid>> fields;   // of every learner's model of the paper's field, first run

  size_t IndexOf(const std::string& label) const {
    const auto at = std::find_if(learners.begin(), learners.end(), [&label](const Learner& learner) { return learner.label == label; });
    return static_cast<size_t>(at - learners.begin());
  }
  bool Has(const std::string& label) const { return IndexOf(label) < learners.size(); }
  std::vector<double> Values(size_t learner, double Trial::*quantity) const {
    std::vector<double> values;
    for (const Trial& trial : trials[learner]) values.push_back(trial.*quantity);
    return values;
  }
  double Median(const std::string& label, double Trial::*quantity) const { return Summarise(Values(IndexOf(label), quantity), false).median; }
  size_t Targets() const { return targets.size() * static_cast<size_t>(scale.targets); }
  const sim::Fleet& FleetOf(size_t target) const { return targets[target / static_cast<size_t>(scale.targets)]; }
  size_t InFleet(size_t target) const { return target % static_cast<size_t>(scale.targets); }
  const Trajectory& Recording(size_t target) const { return FleetOf(target).dataset.trajectories[InFleet(target)]; }
  MatrixXd TrueStates(size_t target) const { return Recording(target).states.rightCols(kLocalizationSamples - kLocalizationContext); }
};

/// @param functions  of the model, shared by its filters.
absl::StatusOr<Trial> RunTrial(const nssm::Bundle& model, const std::shared_ptr<const filter::FilterModel>& functions, const Trajectory& recording) {
  Trial trial;
  const double begin = ThreadSeconds();
  const absl::StatusOr<nssm::Bundle> adapted = AdaptForFilter(model, recording, kLocalizationContext);
  if (IsDivergence(adapted.status())) return trial;
  METAEKF_RETURN_IF_ERROR(adapted.status());
  trial.adaptation_s = ThreadSeconds() - begin;
  const MatrixXd states = recording.states.rightCols(kLocalizationSamples - kLocalizationContext);
  METAEKF_ASSIGN_OR_RETURN(trial.run, FilterAfterContext(*adapted, functions, recording, kLocalizationContext));
  const MatrixXd errors = StateErrors(trial.run.means, states);
  trial.adapted = SummedError(errors);
  trial.coverage = 100 * Coverage(trial.run, errors, kWidth95);
  trial.step_s = trial.run.seconds_per_step;
  METAEKF_ASSIGN_OR_RETURN(const FilterRun unadapted, FilterAfterContext(model, functions, recording, kLocalizationContext));
  trial.unadapted = SummedError(StateErrors(unadapted.means, states));
  METAEKF_ASSIGN_OR_RETURN(const MatrixXd free_run, PredictFreely(ModelOf(*adapted), recording, kLocalizationContext));
  trial.free_run = SummedError(StateErrors(free_run, states));
  return trial;
}

/// Odometry with the vehicle's own geometry, or the average one.
std::vector<double> DeadReckoningErrors(const Study& study, bool own_geometry) {
  std::vector<double> errors;
  for (size_t target = 0; target < study.Targets(); ++target) {
    const Vehicle own = VehicleOf(study.FleetOf(target), static_cast<Index>(study.InFleet(target)));
    const MatrixXd states = DeadReckoning(own_geometry ? own.geometry : AverageGeometry(), study.Recording(target), kLocalizationContext);
    errors.push_back(SummedError(StateErrors(states, study.TrueStates(target))));
  }
  return errors;
}

constexpr char kOwnGeometry[] = "dead reckoning, true geometry", kAverageGeometry[] = "dead reckoning, average geometry";

Table Estimates(const Study& study) {
  Table table{.name = "estimates",
              .title = absl::StrCat("Sum of errors |x - x̂| (m and rad) over 32 s after a context of 8 s; median [quartiles] of ",
                                    study.Targets(), " vehicles"),
              .row_heading = "model",
              .columns = {{"EKF, adapted"}, {"EKF, unadapted"}, {"adapted, no field measured"}, {"95 % bounds hold", "%", true}}};
  for (size_t i = 0; i < study.learners.size(); ++i) {
    table.rows.push_back({study.learners[i].label,
                          {study.Values(i, &Trial::adapted), study.Values(i, &Trial::unadapted), study.Values(i, &Trial::free_run),
                           study.Values(i, &Trial::coverage)}});
  }
  table.rows.push_back({kOwnGeometry, {{}, {}, DeadReckoningErrors(study, true)}});
  table.rows.push_back({kAverageGeometry, {{}, {}, DeadReckoningErrors(study, false)}});
  return table;
}

Table Fields(const Study& study, const sim::MagnetizedSphere& sphere) {
  Table table{.name = "fields",
              .title = absl::StrCat("Root mean square error of the field of magnetization (1, 1) A/m and radius 3 m on ", study.scale.cells, " × ",
                                    study.scale.cells, " cells of |p| ≤ 8 m, A/m"),
              .row_heading = "model",
              .columns = {{"within 0.5 m of the path"}, {"outside the sphere"}, {"everywhere"}},
              .notes = {"No vehicle has been inside the sphere: the jump at its surface counts in the last column only."}};
  for (size_t i = 0; i < study.learners.size(); ++i) {
    table.rows.push_back({study.learners[i].label, {{kInfinity}, {kInfinity}, {kInfinity}}});
    if (!study.fields[i]) continue;
    const FieldErrors errors = CompareFields(*study.fields[i], sphere);
    table.rows.back().cells = {{errors.near_the_path}, {errors.outside}, {errors.everywhere}};
  }
  return table;
}

Table Times(const Study& study) {
  Table table{.name = "times", .title = "Time: training on the wall, the rest of one processor; adaptations judge themselves and find Q and R, too",
              .row_heading = "model",
              .columns = {{"parameters"}, {"training", "s"}, {"memory of it", "MiB"}, {"adaptation", "ms"}, {"EKF step", "µs"}}};
  const auto scaled = [](std::vector<double> values, double factor) {
    for (double& value : values) value *= factor;
    return values;
  };
  for (size_t i = 0; i < study.learners.size(); ++i) {
    Row row{study.learners[i].label, {{}, {}, {}, scaled(study.Values(i, &Trial::adaptation_s), 1e3), scaled(study.Values(i, &Trial::step_s), 1e6)}};
    for (const std::vector<Training>& run : study.trainings) AddCosts(run[i], &row);
    table.rows.push_back(std::move(row));
  }
  return table;
}

std::vector<std::string> Findings(const Study& study) {
  const double dead_reckoning = Summarise(DeadReckoningErrors(study, true), false).median;
  const auto ratio = [](double a, double b) { return base::FormatShort(a / b, 3); };
  std::vector<std::string> findings;
  for (const std::string& label : {std::string(kMamlSwish), std::string(kPriorSwish), Printed(kMamlSwish)}) {
    if (!study.Has(label)) continue;
    const double adapted = study.Median(label, &Trial::adapted);
    findings.push_back(absl::StrCat(label, ": median error of the adapted EKF in its ratio to dead reckoning with the true geometry: ",
                                    ratio(adapted, dead_reckoning), ", to the unadapted EKF: ", ratio(adapted, study.Median(label, &Trial::unadapted)), "."));
  }
  for (const auto& [label, free] : {std::pair{std::string(kMamlSwish), std::string(kMamlFree)}, {kPriorSwish, kPriorFree}, {Printed(kMamlSwish), Printed(kMamlFree)}}) {
    if (!study.Has(label)) continue;
    findings.push_back(absl::StrCat(label, ": median error with a curl-free field in its ratio to that with a free one: ",
                                    ratio(study.Median(label, &Trial::adapted), study.Median(free, &Trial::adapted)), "."));
  }
  for (const auto& [swish, tanh] : {std::pair{std::string(kMamlSwish), std::string(kMamlTanh)}, {Printed(kMamlSwish), Printed(kMamlTanh)}}) {
    if (!study.Has(swish)) continue;
    findings.push_back(absl::StrCat(swish, " in its ratio to ", tanh, ": ", ratio(study.Median(swish, &Trial::adapted), study.Median(tanh, &Trial::adapted)), "."));
  }
  return findings;
}

absl::StatusOr<Picture> DrawErrors(const Study& study) {
  plot::BoxPlot picture{.title = "Errors of estimates, all targets", .x_label = "sum of |x - x̂| (m and rad)", .logarithmic = true};
  for (size_t i = 0; i < study.learners.size(); ++i) {
    const std::vector<double> errors = study.Values(i, &Trial::adapted);
    const size_t failed = Summarise(errors, false).failed;
    const std::string& label = study.learners[i].label;
    picture.boxes.push_back({.label = failed == 0 ? label : absl::StrCat(label, " (", failed, " failed)"), .values = errors});
  }
  picture.boxes.push_back({.label = kOwnGeometry, .values = DeadReckoningErrors(study, true), .colour = plot::Colour::kBlack});
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg(picture));
  return Picture{"errors", std::move(svg)};
}

/// States of a target drawn by lot, with their bounds.
absl::StatusOr<Picture> DrawStates(const Study& study, const std::string& label) {
  const size_t target = std::min(static_cast<size_t>(base::Rng(kFirstSeed, 0).Uniform(0, 1) * static_cast<double>(study.scale.targets)),
                                 static_cast<size_t>(study.scale.targets - 1));
  const FilterRun& run = study.trials[study.IndexOf(label)][target].run;
  const MatrixXd truth = study.TrueStates(target);
  std::vector<double> times;
  for (Index t = 0; t < truth.cols(); ++t) {
    times.push_back(static_cast<double>(t + kLocalizationContext) * study.Recording(target).sample_period_s);
  }
  plot::Figure figure{.title = absl::StrCat("Target ", target, " (drawn by lot), ", label), .x_label = "t (s)"};
  const char* const labels[] = {"p_X (m)", "p_Y (m)", "heading (rad)"};
  for (Index i = 0; i < 3 && run.means.cols() == truth.cols(); ++i) {
    const MatrixXd band = kWidth95 * run.deviations;
    figure.panels.push_back({.y_label = labels[i],
                             .bands = {{.label = "95 % bounds", .x = times, .lower = RowOf(run.means - band, i), .upper = RowOf(run.means + band, i)}},
                             .series = {{.label = "estimate", .x = times, .y = RowOf(run.means, i)},
                                        {.label = "true", .x = times, .y = RowOf(truth, i), .mark = plot::Mark::kDashes, .colour = plot::Colour::kBlack}}});
  }
  if (figure.panels.empty()) figure.panels.push_back({.title = "the adaptation diverged"});
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg(figure));
  return Picture{"states", std::move(svg)};
}

/// |h − ĥ| of a model on the grid.
MatrixXd FieldError(const FieldGrid& field, const FieldGrid& truth) {
  return ((field.x - truth.x).array().square() + (field.y - truth.y).array().square()).sqrt();
}

absl::StatusOr<Picture> DrawFields(const Study& study, const sim::MagnetizedSphere& sphere) {
  plot::FieldMaps picture{.title = "Error of the field", .x_label = "p_X (m)", .y_label = "p_Y (m)", .value_label = "|error| (A/m)",
                          .x_min = -kFieldHalfWidthM, .x_max = kFieldHalfWidthM, .y_min = -kFieldHalfWidthM, .y_max = kFieldHalfWidthM,
                          .logarithmic = true, .low = 1e-4, .high = 1};
  const FieldGrid truth = FieldOf(sphere, study.scale.cells);
  for (const char* label : {kMamlSwish, kMamlTanh, kPriorSwish}) {
    const auto& field = study.fields[study.IndexOf(label)];
    if (field) picture.maps.push_back({label, FieldError(*field, truth)});
  }
  plot::Series path{.mark = plot::Mark::kDashes, .colour = plot::Colour::kBlack};
  for (int i = 0; i <= 360; ++i) {
    const Eigen::Vector2d point = sim::ReferencePath(i * std::numbers::pi / 180);
    path.x.push_back(point[0]);
    path.y.push_back(point[1]);
  }
  picture.curves = {path};
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg(picture));
  return Picture{"field-errors", std::move(svg)};
}

/// Shares of the cells outside the sphere by error, both components.
absl::StatusOr<Picture> DrawHistograms(const Study& study, const sim::MagnetizedSphere& sphere) {
  constexpr int kBins = 61;
  constexpr double kReach = 0.03;  // A/m
  plot::Panel panel{.y_label = "share (%)"};
  const FieldGrid truth = FieldOf(sphere, study.scale.cells);
  for (const char* label : {kMamlSwish, kMamlTanh, kPriorSwish}) {
    const auto& field = study.fields[study.IndexOf(label)];
    if (!field) continue;
    plot::Series series{.label = label};
    std::vector<double> counts(kBins, 0);
    for (const MatrixXd& errors : {MatrixXd(field->x - truth.x), MatrixXd(field->y - truth.y)}) {
      for (const double error : errors.reshaped()) {
        const double bin = std::floor((error / kReach + 1) / 2 * kBins);
        if (bin >= 0 && bin < kBins) counts[static_cast<size_t>(bin)] += 1;
      }
    }
    for (int bin = 0; bin < kBins; ++bin) {
      series.x.push_back(kReach * (2 * (bin + 0.5) / kBins - 1));
      series.y.push_back(100 * counts[static_cast<size_t>(bin)] / static_cast<double>(2 * truth.x.size()));
    }
    panel.series.push_back(std::move(series));
  }
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg({.title = "Errors of the field on the grid", .x_label = "error (A/m)",
                                                             .panels = {std::move(panel)}, .panel_height_px = 320}));
  return Picture{"field-histogram", std::move(svg)};
}

/// Activations with two derivatives: those of swish and tanh never vanish together (paper.tex thm:1, fig:swish).
absl::StatusOr<Picture> DrawActivations() {
  constexpr int kPoints = 401;
  std::vector<double> z(kPoints);
  for (int i = 0; i < kPoints; ++i) z[static_cast<size_t>(i)] = -6 + 12.0 * i / (kPoints - 1);
  plot::Figure figure{.title = "Activations and their derivatives", .x_label = "z", .panel_height_px = 180};
  const char* const labels[] = {"value", "first derivative", "second derivative"};
  for (const int order : {0, 1, 2}) {
    plot::Panel panel{.y_label = labels[order]};
    for (const auto& [label, activation] : {std::pair{"swish", autodiff::Activation::kSwish}, {"tanh", autodiff::Activation::kTanh}}) {
      plot::Series series{.label = label, .x = z, .y = z};
      autodiff::ApplyActivation(activation, order, 1.0, z.data(), series.y.data(), z.size());
      panel.series.push_back(std::move(series));
    }
    figure.panels.push_back(std::move(panel));
  }
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg(figure));
  return Picture{"activations", std::move(svg)};
}

/// Trains everything on one fleet and judges it on its targets.
absl::Status RunSeed(uint64_t seed, const Trajectory& in_papers_field, base::Executor* executor, const OnProgress& on_progress, Study* study) {
  METAEKF_ASSIGN_OR_RETURN(const sim::Fleet fleet, Vehicles(study->scale.sources, seed, executor));
  METAEKF_ASSIGN_OR_RETURN(sim::Fleet target_fleet, Vehicles(study->scale.targets, seed + kTargetSeeds, executor));
  METAEKF_ASSIGN_OR_RETURN(std::vector<Training> trainings, TrainAll(study->learners, fleet.dataset, {}, seed, executor, on_progress));
  const size_t learners = study->learners.size(), targets = target_fleet.dataset.trajectories.size(), before = study->Targets();
  study->targets.push_back(std::move(target_fleet));
  for (std::vector<Trial>& trials : study->trials) trials.resize(before + targets);
  std::vector<std::shared_ptr<const filter::FilterModel>> functions(learners);
  for (size_t i = 0; i < learners; ++i) {
    if (trainings[i].bundle.ok()) functions[i] = filter::FilterModel::Create(*trainings[i].bundle);
  }
  const auto judge = [&](size_t job) -> absl::Status {
    const size_t learner = job / (targets + 1), target = job % (targets + 1);
    const absl::StatusOr<nssm::Bundle>& model = trainings[learner].bundle;
    if (!model.ok()) return absl::OkStatus();
    if (target < targets) {
      METAEKF_ASSIGN_OR_RETURN(study->trials[learner][before + target], RunTrial(*model, functions[learner], study->Recording(before + target)));
      return absl::OkStatus();
    }
    if (seed != kFirstSeed) return absl::OkStatus();
    const absl::StatusOr<nssm::Bundle> adapted = AdaptForFilter(*model, in_papers_field, kLocalizationContext);
    if (adapted.ok()) study->fields[learner] = FieldOf(*adapted, study->scale.cells);
    return IsDivergence(adapted.status()) ? absl::OkStatus() : adapted.status();
  };
  METAEKF_RETURN_IF_ERROR(RunJobs(learners * (targets + 1), executor, "models of targets", on_progress, judge));
  study->trainings.push_back(std::move(trainings));
  return absl::OkStatus();
}

absl::StatusOr<Report> Run(const Options& options, base::Executor* executor, const OnProgress& on_progress) {
  Study study{.scale = ScaleOf(options), .learners = LocalizationLearners(options.budget)};
  study.trials.resize(study.learners.size());
  study.fields.resize(study.learners.size());
  METAEKF_ASSIGN_OR_RETURN(const sim::Fleet papers, VehicleInThePapersField(kFirstSeed + kTargetSeeds, executor));
  for (int run = 0; run < study.scale.runs; ++run) {
    METAEKF_RETURN_IF_ERROR(RunSeed(kFirstSeed + static_cast<uint64_t>(run), papers.dataset.trajectories[0], executor, on_progress, &study));
  }

  const sim::MagnetizedSphere sphere = VehicleOf(papers, 0).sphere;
  Report report{{Estimates(study), Fields(study, sphere), Times(study)}, Findings(study), {}};
  METAEKF_ASSIGN_OR_RETURN(Picture errors, DrawErrors(study));
  METAEKF_ASSIGN_OR_RETURN(Picture states, DrawStates(study, kMamlSwish));
  METAEKF_ASSIGN_OR_RETURN(Picture fields, DrawFields(study, sphere));
  METAEKF_ASSIGN_OR_RETURN(Picture histograms, DrawHistograms(study, sphere));
  METAEKF_ASSIGN_OR_RETURN(Picture activations, DrawActivations());
  report.pictures = {std::move(errors), std::move(states), std::move(fields), std::move(histograms), std::move(activations)};
  return report;
}

}  // namespace

Experiment Localization() {
  return {"localization", "EKF of vehicles in unknown magnetic fields: meta-learners, activations, fields with and without curl", Protocol, Run};
}

}  // namespace metaekf::experiments
