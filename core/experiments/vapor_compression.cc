#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>
#include <optional>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/base/rng.h"
#include "core/base/status.h"
#include "core/experiments/filter_run.h"
#include "core/experiments/jobs.h"
#include "core/experiments/studies.h"
#include "core/experiments/vapor_compression_learners.h"
#include "core/physics/polyhedron.h"
#include "core/plot/box_plot.h"
#include "core/plot/svg.h"
#include "core/sim/simulate.h"
#include "core/sim/vapor_compression.h"

namespace metaekf::experiments {
namespace {

using data::Trajectory;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using nlohmann::json;

constexpr uint64_t kFirstSeed = 1;          // of the runs; what was chosen was chosen on seeds from 1000 on
constexpr uint64_t kTargetSeeds = 1 << 20;  // added: targets are no systems of the fleet
constexpr Index kStates = 3 * sim::kVaporCompressionVolumes;
constexpr double kWidth95 = 1.959964, kThreeSigma = 3;
constexpr double kInfinity = std::numeric_limits<double>::infinity();

struct Scale {
  int64_t sources, targets;                  // of each run
  int64_t fleet_samples, samples, context;   // of a source, of a target, and its first
  int runs;
};

Scale ScaleOf(const Options& options) {
  Scale scale{200, 50, 5000, 5000, 200, 1};
  if (options.budget == Budget::kQuick) scale = {40, 8, 2000, 1200, 200, 1};
  if (options.budget == Budget::kTiny) scale = {5, 2, 120, 120, 60, 1};
  if (options.seeds) scale.runs = *options.seeds;
  return scale;
}

json Protocol(const Options& options) {
  const Scale scale = ScaleOf(options);
  json learners = json::array();
  for (const Learner& learner : VaporCompressionLearners(options.budget)) learners.push_back(ToJson(learner));
  return {{"experiment", "vapor-compression"}, {"runs", scale.runs}, {"first_seed", kFirstSeed},
          {"target_seed", absl::StrCat("seed + ", kTargetSeeds)}, {"sources", scale.sources}, {"source_samples", scale.fleet_samples},
          {"targets", scale.targets}, {"target_samples", scale.samples}, {"context_samples", scale.context},
          {"settings", VaporCompressionSettings()}, {"learners", learners}};
}

/// Ways to put estimates of the adapted model inside its set.
constexpr std::array kProjections = {filter::Projection::kQuadraticProgram, filter::Projection::kAutoencoder, filter::Projection::kNone};
constexpr size_t kProgram = 0, kAutoencoder = 1, kNotProjected = 2, kWays = kProjections.size();

/// What a model of one target has achieved; infinite where it diverged, NaN where there is nothing to project into.
struct Trial {
  std::array<double, kWays> error{kInfinity, kInfinity, kInfinity};  // RMSE over the states, each in deviations over the fleet
  std::array<double, kWays> outside{};                               // estimates out of order, % of them
  std::array<double, kWays> step_s{kInfinity, kInfinity, kInfinity};
  double unadapted = kInfinity, free_run = kInfinity;
  double coverage = 0;      // of 95 % bounds, adapted and projected if it is
  double projection = 0;    // mean size, deviations
  double adaptation_s = kInfinity;
  FilterRun adapted_run, unadapted_run;  // of the learner that figures show
};

struct Study {
  Scale scale;
  std::vector<Learner> learners;
  physics::Polyhedron order;
  VectorXd deviations;                            // of the states over the fleet of the first run
  std::vector<std::vector<Training>> trainings;   // by run and learner
  std::vector<data::Dataset> targets;             // by run
  std::vector<std::vector<Trial>> trials;         // by learner and target, those of one run behind those of the other

  size_t IndexOf(const std::string& label) const {
    const auto at = std::find_if(learners.begin(), learners.end(), [&label](const Learner& learner) { return learner.label == label; });
    return static_cast<size_t>(at - learners.begin());
  }
  bool IsConstrained(size_t learner) const { return learners[learner].specification["model"].contains("state_constraint"); }
  /// Of the way that a learner's estimates go by default.
  size_t Way(size_t learner) const { return IsConstrained(learner) ? kProgram : kNotProjected; }
  std::vector<double> Values(size_t learner, const std::function<double(const Trial&)>& quantity) const {
    std::vector<double> values;
    for (const Trial& trial : trials[learner]) values.push_back(quantity(trial));
    return values;
  }
  std::vector<double> Errors(size_t learner, size_t way) const {
    if (way != kNotProjected && !IsConstrained(learner)) return {};
    return Values(learner, [way](const Trial& trial) { return trial.error[way]; });
  }
  double MedianError(const std::string& label) const {
    const size_t learner = IndexOf(label);
    return Summarise(Errors(learner, Way(learner)), false).median;
  }
  size_t Targets() const { return targets.size() * static_cast<size_t>(scale.targets); }
  const Trajectory& Recording(size_t target) const {
    return targets[target / static_cast<size_t>(scale.targets)].trajectories[target % static_cast<size_t>(scale.targets)];
  }
};

double ScaledError(const MatrixXd& estimates, const MatrixXd& states, const VectorXd& deviations) {
  const double error = std::sqrt((deviations.cwiseInverse().asDiagonal() * (estimates - states)).array().square().mean());
  return std::isfinite(error) ? error : kInfinity;
}

double ShareOutside(const MatrixXd& states, const physics::Polyhedron& set) {
  Index outside = 0;
  for (Index t = 0; t < states.cols(); ++t) outside += physics::Contains(set, states.col(t)) ? 0 : 1;
  return 100 * static_cast<double>(outside) / static_cast<double>(states.cols());
}

/// @param functions  of the model, shared by its filters.
absl::StatusOr<Trial> RunTrial(const Study& study, size_t learner, const nssm::Bundle& model,
                               const std::shared_ptr<const filter::FilterModel>& functions, const Trajectory& recording) {
  Trial trial;
  const int64_t context = study.scale.context;
  const double begin = ThreadSeconds();
  const absl::StatusOr<nssm::Bundle> adapted = AdaptForFilter(model, recording, context);
  if (IsDivergence(adapted.status())) return trial;
  METAEKF_RETURN_IF_ERROR(adapted.status());
  trial.adaptation_s = ThreadSeconds() - begin;
  const MatrixXd states = recording.states.rightCols(recording.length() - context);
  const size_t usual = study.Way(learner);
  const bool is_drawn = study.learners[learner].label == kVaporPrior;
  for (size_t way = 0; way < kWays; ++way) {
    if (way != kNotProjected && !study.IsConstrained(learner)) continue;
    METAEKF_ASSIGN_OR_RETURN(FilterRun run, FilterAfterContext(*adapted, functions, recording, context, {.projection = kProjections[way]}));
    trial.error[way] = ScaledError(run.means, states, study.deviations);
    trial.outside[way] = ShareOutside(run.means, study.order);
    trial.step_s[way] = run.seconds_per_step;
    if (way != usual) continue;
    trial.coverage = 100 * Coverage(run, run.means - states, kWidth95);
    trial.projection = run.projection.mean();
    if (is_drawn) trial.adapted_run = std::move(run);
  }
  METAEKF_ASSIGN_OR_RETURN(FilterRun unadapted, FilterAfterContext(model, functions, recording, context, {.projection = kProjections[usual]}));
  trial.unadapted = ScaledError(unadapted.means, states, study.deviations);
  if (is_drawn) trial.unadapted_run = std::move(unadapted);
  METAEKF_ASSIGN_OR_RETURN(const MatrixXd free_run, PredictFreely(ModelOf(*adapted), recording, context));
  trial.free_run = ScaledError(free_run, states, study.deviations);
  return trial;
}

Table Estimates(const Study& study) {
  Table table{.name = "estimates",
              .title = absl::StrCat("RMSE of 24 states, each in its deviations over the fleet, behind a context of 20 s; median [quartiles] of ", study.Targets(), " systems"),
              .row_heading = "model",
              .columns = {{"EKF, adapted"}, {"EKF, unadapted"}, {"by autoencoder"}, {"not projected"}, {"adapted, nothing measured"}, {"95 % bounds hold", "%", true}},
              .notes = {"Estimates are put inside the set by quadratic programming where the column does not say otherwise; a model without constraints has nothing to put them into."}};
  for (size_t i = 0; i < study.learners.size(); ++i) {
    table.rows.push_back({study.learners[i].label,
                          {study.Errors(i, study.Way(i)), study.Values(i, [](const Trial& trial) { return trial.unadapted; }), study.Errors(i, kAutoencoder),
                           study.Errors(i, kNotProjected), study.Values(i, [](const Trial& trial) { return trial.free_run; }),
                           study.Values(i, [](const Trial& trial) { return trial.coverage; })}});
  }
  return table;
}

Table Violations(const Study& study) {
  Table table{.name = "violations",
              .title = "Estimates whose pressures rise along the flow, beyond rounding, and how far those of the quadratic program were moved",
              .row_heading = "model",
              .columns = {{"quadratic program", "%"}, {"autoencoder", "%"}, {"not projected", "%"}, {"moved by, mean", "deviations"}}};
  for (size_t i = 0; i < study.learners.size(); ++i) {
    const auto share = [&](size_t way) {
      return way != kNotProjected && !study.IsConstrained(i) ? std::vector<double>() : study.Values(i, [way](const Trial& trial) { return trial.outside[way]; });
    };
    const std::vector<double> moved = study.IsConstrained(i) ? study.Values(i, [](const Trial& trial) { return trial.projection; }) : std::vector<double>();
    table.rows.push_back({study.learners[i].label, {share(kProgram), share(kAutoencoder), share(kNotProjected), moved}});
  }
  return table;
}

Table Times(const Study& study) {
  Table table{.name = "times", .title = "Time: training on the wall, the rest of one processor; adaptations judge themselves and find Q and R, too",
              .row_heading = "model",
              .columns = {{"parameters"}, {"training", "s"}, {"memory of it", "MiB"}, {"adaptation", "ms"}, {"EKF step", "µs"}, {"by autoencoder", "µs"}, {"not projected", "µs"}}};
  for (size_t i = 0; i < study.learners.size(); ++i) {
    const auto step = [&](size_t way) {
      return way != kNotProjected && !study.IsConstrained(i) ? std::vector<double>() : study.Values(i, [way](const Trial& trial) { return 1e6 * trial.step_s[way]; });
    };
    Row row{study.learners[i].label,
            {{}, {}, {}, study.Values(i, [](const Trial& trial) { return 1e3 * trial.adaptation_s; }), step(study.Way(i)), step(kAutoencoder), step(kNotProjected)}};
    for (const std::vector<Training>& run : study.trainings) AddCosts(run[i], &row);
    table.rows.push_back(std::move(row));
  }
  return table;
}

std::vector<std::string> Findings(const Study& study) {
  const auto ratio = [](double a, double b) { return base::FormatShort(a / b, 3); };
  std::vector<std::string> findings;
  const double universal = study.MedianError(kVaporUniversal);
  for (const char* label : {kVaporPrior, kVaporMaml}) {
    const double adapted = study.MedianError(label);
    const double unadapted = Summarise(study.Values(study.IndexOf(label), [](const Trial& trial) { return trial.unadapted; }), false).median;
    findings.push_back(absl::StrCat(label, ": median error of the adapted EKF in its ratio to the unadapted one: ", ratio(adapted, unadapted),
                                    ", to one model for all: ", ratio(adapted, universal), "."));
  }
  findings.push_back(absl::StrCat("Being told the pipe's length has one model for all come to ", ratio(study.MedianError(kVaporTold), universal), " of its error."));
  for (const char* label : {kVaporPrior, kVaporUniversal}) {
    findings.push_back(absl::StrCat(label, ": median error of the constrained model in its ratio to the unconstrained: ",
                                    ratio(study.MedianError(label), study.MedianError(Unconstrained(label))), "."));
  }
  double outside = 0;
  for (size_t i = 0; i < study.learners.size(); ++i) {
    for (const Trial& trial : study.trials[i]) outside += study.IsConstrained(i) ? trial.outside[kProgram] + trial.outside[kAutoencoder] : 0;
  }
  findings.push_back(outside == 0 ? "No projected estimate had pressures that rise along the flow." : "Projected estimates had pressures that rise along the flow.");
  return findings;
}

absl::StatusOr<Picture> DrawErrors(const Study& study) {
  plot::BoxPlot picture{.title = "Errors of estimates, all targets", .x_label = "RMSE of 24 states (deviations over the fleet)", .logarithmic = true};
  for (size_t i = 0; i < study.learners.size(); ++i) {
    const std::string& label = study.learners[i].label;
    picture.boxes.push_back({.label = label, .values = study.Errors(i, study.Way(i))});
    if (label == kVaporPrior) {
      picture.boxes.push_back({.label = absl::StrCat(label, ", unadapted"), .values = study.Values(i, [](const Trial& trial) { return trial.unadapted; })});
      picture.boxes.push_back({.label = absl::StrCat(label, ", by autoencoder"), .values = study.Errors(i, kAutoencoder)});
      picture.boxes.push_back({.label = absl::StrCat(label, ", not projected"), .values = study.Errors(i, kNotProjected)});
    }
  }
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg(picture));
  return Picture{"errors", std::move(svg)};
}

/// States that figures show: index, label with its unit, units of it in one of the simulator's.
struct Shown {
  Index state;
  const char* label;
  double factor;
};
constexpr std::array kShown = {Shown{0, "p[1] (kPa)", 1e-3}, Shown{7, "p[8] (kPa)", 1e-3}, Shown{10, "h[3] (kJ/kg)", 1e-3},
                               Shown{14, "h[7] (kJ/kg)", 1e-3}, Shown{18, "T[3] (K)", 1}};

/// Estimates of a target drawn by lot, with bounds of ± 3σ, adapted and not (paper.tex fig:xy_meta_v_nometa).
absl::StatusOr<Picture> DrawStates(const Study& study) {
  constexpr Index kLongest = 1000;  // samples that can be told apart
  const size_t target = std::min(static_cast<size_t>(base::Rng(kFirstSeed, 0).Uniform(0, 1) * static_cast<double>(study.scale.targets)),
                                 static_cast<size_t>(study.scale.targets - 1));
  const Trial& trial = study.trials[study.IndexOf(kVaporPrior)][target];
  const Index context = study.scale.context, count = std::min<Index>(kLongest, study.scale.samples - context);
  const MatrixXd truth = study.Recording(target).states.middleCols(context, count);
  std::vector<double> times;
  for (Index t = 0; t < count; ++t) times.push_back(static_cast<double>(t + context) * sim::kVaporCompressionSamplePeriodS);
  plot::Figure figure{.title = absl::StrCat("Target ", target, " (drawn by lot), ", kVaporPrior), .x_label = "t (s)", .panel_height_px = 170};
  for (const Shown& shown : kShown) {
    plot::Panel panel{.y_label = shown.label};
    for (const auto& [label, run, colour] : {std::tuple{"adapted", &trial.adapted_run, plot::Colour::kGreen}, {"unadapted", &trial.unadapted_run, plot::Colour::kVermilion}}) {
      if (run->means.cols() < count) continue;
      const MatrixXd means = shown.factor * run->means.leftCols(count), band = kThreeSigma * shown.factor * run->deviations.leftCols(count);
      panel.bands.push_back({.label = absl::StrCat(label, ", ± 3σ"), .x = times, .lower = RowOf(means - band, shown.state), .upper = RowOf(means + band, shown.state), .colour = colour});
      panel.series.push_back({.label = label, .x = times, .y = RowOf(means, shown.state), .colour = colour});
    }
    panel.series.push_back({.label = "true", .x = times, .y = RowOf(shown.factor * truth, shown.state), .mark = plot::Mark::kDashes, .colour = plot::Colour::kBlack});
    figure.panels.push_back(std::move(panel));
  }
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg(figure));
  return Picture{"states", std::move(svg)};
}

/// The same inputs to systems of other masses of refrigerant (paper.tex fig:vcs_overview_diag [C]).
absl::StatusOr<Picture> DrawRange(const Study& study) {
  constexpr std::array kLengths = {20.0, 25.0, 30.0, 35.0, 40.0};
  constexpr double kSettleS = 50;
  const MatrixXd inputs = study.Recording(0).inputs.leftCols(std::min<Index>(600, study.Recording(0).length()));
  plot::Figure figure{.title = "Range of dynamics over the mass of refrigerant, the same inputs", .x_label = "t (s)", .panel_height_px = 170};
  for (const Shown& shown : kShown) figure.panels.push_back({.y_label = shown.label});
  for (const double length : kLengths) {
    const sim::VaporCompressionRun run = sim::SimulateVaporCompression(length, inputs, kSettleS);
    std::vector<double> times;
    for (Index t = 0; t < run.states.cols(); ++t) times.push_back(static_cast<double>(t) * sim::kVaporCompressionSamplePeriodS);
    for (size_t k = 0; k < kShown.size(); ++k) {
      figure.panels[k].series.push_back({.label = k == 0 ? absl::StrCat(base::FormatShort(run.mass_kg[0], 3), " kg") : "", .x = times,
                                         .y = RowOf(kShown[k].factor * run.states, kShown[k].state)});
    }
  }
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg(figure));
  return Picture{"refrigerant-mass", std::move(svg)};
}

/// The recordings with the length of the pipe as an input that stays as it is.
data::Dataset Told(const sim::Fleet& fleet) {
  data::Dataset told = fleet.dataset;
  told.input_names.push_back(absl::StrCat("u", told.input_names.size() + 1));
  for (size_t i = 0; i < told.trajectories.size(); ++i) {
    MatrixXd& inputs = told.trajectories[i].inputs;
    inputs.conservativeResize(inputs.rows() + 1, Eigen::NoChange);
    inputs.bottomRows(1).setConstant(fleet.parameters.values(static_cast<Index>(i), 0));
  }
  return told;
}

VectorXd DeviationsOf(const data::Dataset& fleet) {
  VectorXd sum = VectorXd::Zero(kStates), squares = VectorXd::Zero(kStates);
  double count = 0;
  for (const Trajectory& trajectory : fleet.trajectories) {
    sum += trajectory.states.rowwise().sum();
    count += static_cast<double>(trajectory.length());
  }
  for (const Trajectory& trajectory : fleet.trajectories) squares += (trajectory.states.colwise() - VectorXd(sum / count)).rowwise().squaredNorm();
  return (squares / count).cwiseSqrt();
}

/// Trains everything on one fleet and judges it on its targets.
absl::Status RunSeed(uint64_t seed, base::Executor* executor, const OnProgress& on_progress, Study* study) {
  const auto request = [&](int64_t systems, uint64_t of, int64_t samples) {
    return sim::Request{.system = "vapor-compression", .systems = systems, .seed = of, .steps = samples, .settings = VaporCompressionSettings()};
  };
  const Scale& scale = study->scale;
  METAEKF_ASSIGN_OR_RETURN(const sim::Fleet fleet, SimulateFleet(request(scale.sources, seed, scale.fleet_samples), executor, "simulating the fleet", on_progress));
  METAEKF_ASSIGN_OR_RETURN(sim::Fleet target_fleet,
                           SimulateFleet(request(scale.targets, seed + kTargetSeeds, scale.samples), executor, "simulating targets", on_progress));
  if (seed == kFirstSeed) study->deviations = DeviationsOf(fleet.dataset);
  const std::vector<Learner> untold(study->learners.begin(), study->learners.end() - 1);
  METAEKF_ASSIGN_OR_RETURN(std::vector<Training> trainings, TrainAll(untold, fleet.dataset, {}, seed, executor, on_progress));
  METAEKF_ASSIGN_OR_RETURN(std::vector<Training> told, TrainAll({study->learners.back()}, Told(fleet), {}, seed, executor, on_progress));
  trainings.push_back(std::move(told.front()));
  const data::Dataset told_targets = Told(target_fleet);
  const size_t learners = study->learners.size(), targets = target_fleet.dataset.trajectories.size(), before = study->Targets();
  study->targets.push_back(std::move(target_fleet.dataset));
  for (std::vector<Trial>& trials : study->trials) trials.resize(before + targets);
  std::vector<std::shared_ptr<const filter::FilterModel>> functions(learners);
  for (size_t i = 0; i < learners; ++i) {
    if (trainings[i].bundle.ok()) functions[i] = filter::FilterModel::Create(*trainings[i].bundle);
  }
  const auto judge = [&](size_t job) -> absl::Status {
    const size_t learner = job / targets, target = job % targets;
    const absl::StatusOr<nssm::Bundle>& model = trainings[learner].bundle;
    if (!model.ok()) return absl::OkStatus();
    const Trajectory& recording = learner + 1 == learners ? told_targets.trajectories[target] : study->Recording(before + target);
    METAEKF_ASSIGN_OR_RETURN(study->trials[learner][before + target], RunTrial(*study, learner, *model, functions[learner], recording));
    return absl::OkStatus();
  };
  METAEKF_RETURN_IF_ERROR(RunJobs(learners * targets, executor, "models of targets", on_progress, judge));
  study->trainings.push_back(std::move(trainings));
  return absl::OkStatus();
}

absl::StatusOr<Report> Run(const Options& options, base::Executor* executor, const OnProgress& on_progress) {
  Study study{.scale = ScaleOf(options), .learners = VaporCompressionLearners(options.budget)};
  METAEKF_ASSIGN_OR_RETURN(study.order, nssm::PolyhedronOf({.matrix = PressureOrder()}, static_cast<int32_t>(kStates)));
  study.trials.resize(study.learners.size());
  for (int run = 0; run < study.scale.runs; ++run) {
    METAEKF_RETURN_IF_ERROR(RunSeed(kFirstSeed + static_cast<uint64_t>(run), executor, on_progress, &study));
  }
  Report report{{Estimates(study), Violations(study), Times(study)}, Findings(study), {}};
  METAEKF_ASSIGN_OR_RETURN(Picture errors, DrawErrors(study));
  METAEKF_ASSIGN_OR_RETURN(Picture states, DrawStates(study));
  METAEKF_ASSIGN_OR_RETURN(Picture range, DrawRange(study));
  report.pictures = {std::move(errors), std::move(states), std::move(range)};
  return report;
}

}  // namespace

Experiment VaporCompressionStudy() {
  return {"vapor-compression", "EKF of refrigeration cycles of unknown mass: adapted and not, with pressures in order by constraint and without", Protocol, Run};
}

}  // namespace metaekf::experiments
