#include <algorithm>
#include <cmath>
#include <limits>

#include "absl/strings/str_join.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/data/split.h"
#include "core/experiments/classical.h"
#include "core/experiments/jobs.h"
#include "core/experiments/learner.h"
#include "core/experiments/studies.h"
#include "core/plot/heat_map.h"
#include "core/sim/simulate.h"

namespace metaekf::experiments {
namespace {

using data::Trajectory;
using nlohmann::json;

constexpr uint64_t kFirstSeed = 1;          // of runs: fleet, initialisation and sampling
constexpr int64_t kTargetSamples = 1000;    // 10 s
constexpr int kEncoderLayers = 5;
constexpr int kArxOrder = 5;
constexpr int kShares[] = {10, 20, 30, 40, 50, 60, 70, 80, 90};  // % of the target's data

struct Scale {
  int runs;
  int64_t sources;
  std::optional<int64_t> source_samples;
};

Scale ScaleOf(const Options& options) {
  Scale scale = options.budget == Budget::kFull    ? Scale{20, 200, {}}
                : options.budget == Budget::kQuick ? Scale{1, 200, {}}
                                                   : Scale{1, 4, 400};
  if (options.seeds) scale.runs = *options.seeds;
  return scale;
}

/// The paper's shape, an encoder of 5 layers, with narrower layers and smooth activations. Inner rates begin at the inverse
/// curvature of each tensor and are learned, so that no mask is at a disadvantage by its rate.
constexpr char kCommon[] = R"json({
  "model": {
    "case": "STATE_INPUT_OUTPUT", "latent_size": 8, "precision": "FLOAT64",
    "encoder": {"hidden_widths": [16, 16, 16, 16], "activation": "TANH"},
    "transition": {"form": "AUTONOMOUS", "bypass": "SKIP",
                   "increment_scale": 0.02, "block": {"hidden_widths": [16], "activation": "TANH"}}
  },
  "loss": {"horizon": 20, "stride": 40, "rollout": "STATE"},
  "inner_loop": {"steps": 5, "learning_rate": 1, "learned_rates": true, "curvature_rates": true},
  "adaptation": {"steps": 10},
  "context_samples": 200, "target_samples": 200, "contexts_at_start": true, "task_batch": 4, "clip_norm": 0.1,
  "validation_period": 100, "iterations": 4000, "warmup_iterations": 3000, "warmup_horizon": 10,
  "warmup_lr": 0.01, "outer_lr": 0.001, "final_outer_lr": 2e-5
})json";

/// "ANIL_AdaptEnc12_Fix345S": the layers of 1 … k, or of k + 1 … 5 and S, adapt; decoders always do.
Learner AnilLearner(int k, bool first_layers, const json& common) {
  std::string low, high;
  for (int layer = 1; layer <= kEncoderLayers; ++layer) absl::StrAppend(layer <= k ? &low : &high, layer);
  Learner learner{.specification = common};
  std::string mask = "*_decoder";
  if (first_layers) {
    learner.label = absl::StrCat("ANIL_AdaptEnc", low, "_Fix", high, "S");
    absl::StrAppend(&mask, ",encoder.0-", k - 1);
  } else {
    learner.label = absl::StrCat("ANIL_FixEnc", low, "_AdaptEnc", high, "S");
    absl::StrAppend(&mask, ",transition,encoder.", k, "-", kEncoderLayers - 1);
  }
  learner.specification["algorithm"] = "MAML";
  learner.specification["inner_loop"]["adapted_mask"] = mask;
  return learner;
}

std::vector<Learner> Learners(Budget budget) {
  json common = json::parse(kCommon);
  if (budget == Budget::kTiny) common.merge_patch({{"iterations", 4}, {"warmup_iterations", 2}, {"loss", {{"horizon", 2}, {"stride", 80}}}});
  std::vector<Learner> learners = {{"MAML", TrainingData::kFleet, common}, {"FO-MAML", TrainingData::kFleet, common}};
  learners[0].specification["algorithm"] = "MAML";
  learners[1].specification["algorithm"] = "FIRST_ORDER_MAML";
  for (int k = 1; k <= kEncoderLayers; ++k) learners.push_back(AnilLearner(k, true, common));
  for (int k = 0; k < kEncoderLayers; ++k) learners.push_back(AnilLearner(k, false, common));
  return learners;
}

sim::Request TargetRequest() {
  return {.system = "van-der-pol", .systems = 1, .seed = 0, .steps = kTargetSamples, .settings = {{"nominal", "1"}}};
}

json Protocol(const Options& options) {
  const Scale scale = ScaleOf(options);
  json learners = json::array();
  for (const Learner& learner : Learners(options.budget)) learners.push_back(ToJson(learner));
  return {{"experiment", "anil-heatmap"},
          {"runs", scale.runs},
          {"first_seed", kFirstSeed},
          {"sources", scale.sources},
          {"target", "theta 1.572, x (1, -0.5), 10 s; adapted to its first part, simulated freely from its first sample"},
          {"noise_std", 0},
          {"shares_percent", kShares},
          {"learners", learners},
          {"classical", {Arx(kArxOrder).label}}};
}

/// RMSE of both states over all 10 s, simulated from the first sample, so that shares compare; not a number where the model
/// diverged.
absl::StatusOr<double> Error(const absl::StatusOr<SystemModel>& model, const Trajectory& recording) {
  constexpr double kFailed = std::numeric_limits<double>::quiet_NaN(), kDiverged = 1e3;
  if (IsDivergence(model.status())) return kFailed;
  METAEKF_RETURN_IF_ERROR(model.status());
  METAEKF_ASSIGN_OR_RETURN(const Eigen::MatrixXd free, PredictFreely(*model, recording, model->warmup));
  const double error = std::sqrt((free - recording.states.rightCols(free.cols())).array().square().mean());
  return error < kDiverged ? error : kFailed;
}

/// A row each of `labels`.
Table ToTable(const std::vector<std::string>& labels, const std::vector<std::vector<std::vector<double>>>& errors, int runs) {
  Table table{.name = "rmse", .title = absl::StrCat("RMSE of both states in a free run of 10 s, by share of it adapted to; mean ± "
                                                    "standard deviation of ", runs, " runs"),
              .summary = Summary::kMean, .row_heading = "learner"};
  for (const int share : kShares) table.columns.push_back({absl::StrCat(share, " %")});
  for (size_t i = 0; i < labels.size(); ++i) table.rows.push_back({labels[i], errors[i]});
  table.notes = {"Linear ARX is fitted to the same samples; the target is the same in all runs, and so is this row."};
  return table;
}

double MeanOf(const Table& table, size_t row, size_t column) { return MeanUnlessFailed(table.rows[row].cells[column]); }

/// Index of the row with the least (or greatest) mean in a column, among the first rows.
size_t Extreme(const Table& table, size_t rows, size_t column, bool least) {
  size_t extreme = 0;
  for (size_t row = 1; row < rows; ++row) {
    const double value = MeanOf(table, row, column), so_far = MeanOf(table, extreme, column);
    if (least ? value < so_far : value > so_far) extreme = row;
  }
  return extreme;
}

/// What the paper concludes from its figure, asked of these numbers: those of the learners, which come first.
std::vector<std::string> Findings(const Table& table, size_t learners) {
  std::vector<std::string> best, worst;
  size_t full_is_best = 0, helped = 0;
  for (size_t column = 0; column < std::size(kShares); ++column) {
    const size_t least = Extreme(table, learners, column, true);
    full_is_best += least < 2 ? 1 : 0;
    best.push_back(absl::StrCat(kShares[column], " % ", table.rows[least].label));
    worst.push_back(absl::StrCat(kShares[column], " % ", table.rows[Extreme(table, learners, column, false)].label));
  }
  for (size_t row = 0; row < learners; ++row) {
    helped += MeanOf(table, row, 4) < MeanOf(table, row, 0) ? 1 : 0;
  }
  return {absl::StrCat("Best at each share: ", absl::StrJoin(best, ", "), "."),
          absl::StrCat("Worst at each share: ", absl::StrJoin(worst, ", "), "."),
          absl::StrCat("The paper: adapting everything (MAML, FO-MAML) is best. Here it is at ", full_is_best, " of ",
                       std::size(kShares), " shares."),
          absl::StrCat("The paper: 10 % is too little. Here ", helped, " of ", learners,
                       " learners are better with 50 % than with 10 %.")};
}

/// @param learners  rows from the first whose values the colours compare; a failing ARX has the darkest.
absl::StatusOr<Picture> Draw(const Table& table, size_t learners) {
  plot::HeatMap map{.title = "RMSE in a free run of 10 s, mean over runs; empty where one failed", .x_label = "share of the target's data adapted to",
                    .values = Eigen::MatrixXd(table.rows.size(), table.columns.size()), .logarithmic = true,
                    .scale_rows = static_cast<Eigen::Index>(learners)};
  for (const Column& column : table.columns) map.columns.push_back(column.name);
  for (size_t row = 0; row < table.rows.size(); ++row) {
    map.rows.push_back(table.rows[row].label);
    for (size_t column = 0; column < table.columns.size(); ++column) {
      map.values(static_cast<Eigen::Index>(row), static_cast<Eigen::Index>(column)) = MeanOf(table, row, column);
    }
  }
  METAEKF_ASSIGN_OR_RETURN(std::string svg, plot::RenderSvg(map));
  return Picture{"anil-heatmap", std::move(svg)};
}

absl::StatusOr<Report> Run(const Options& options, base::Executor* executor, const OnProgress& on_progress) {
  const Scale scale = ScaleOf(options);
  const std::vector<Learner> learners = Learners(options.budget);
  METAEKF_ASSIGN_OR_RETURN(const sim::Fleet target, sim::Simulate(TargetRequest(), *executor));
  const Trajectory& recording = target.dataset.trajectories[0];
  const size_t runs = static_cast<size_t>(scale.runs), shares = std::size(kShares);
  std::vector<Trajectory> contexts;
  for (const int share : kShares) {
    METAEKF_ASSIGN_OR_RETURN(Trajectory context, data::FirstSamples(recording, kTargetSamples * share / 100));
    contexts.push_back(std::move(context));
  }
  std::vector<std::vector<std::vector<double>>> errors(
      learners.size(), {shares, std::vector<double>(runs, std::numeric_limits<double>::quiet_NaN())});
  std::vector<std::vector<double>> seconds(learners.size(), std::vector<double>(runs));
  const size_t jobs = learners.size() * runs;
  const absl::Status studied = RunJobs(jobs, executor, "models trained", on_progress, [&](size_t job) -> absl::Status {
    const size_t run = job / learners.size(), i = job % learners.size();
    base::Executor* const serial = base::CallingThread();
    METAEKF_ASSIGN_OR_RETURN(const sim::Fleet fleet,
                             sim::Simulate({.system = "van-der-pol", .systems = scale.sources, .seed = kFirstSeed + run,
                                            .steps = scale.source_samples}, *serial));
    const double begin = ThreadSeconds();
    const absl::StatusOr<nssm::Bundle> bundle = TrainLearner(learners[i], fleet.dataset, {}, kFirstSeed + run, serial);
    seconds[i][run] = ThreadSeconds() - begin;
    if (IsDivergence(bundle.status())) return absl::OkStatus();
    METAEKF_RETURN_IF_ERROR(bundle.status());
    for (size_t k = 0; k < shares; ++k) {
      METAEKF_ASSIGN_OR_RETURN(errors[i][k][run], Error(AdaptToContext(*bundle, contexts[k]), recording));
    }
    return absl::OkStatus();
  });
  METAEKF_RETURN_IF_ERROR(studied);
  std::vector<std::string> labels;
  for (const Learner& learner : learners) labels.push_back(learner.label);
  const ClassicalModel arx = Arx(kArxOrder);
  labels.push_back(arx.label);
  errors.emplace_back();
  for (const Trajectory& context : contexts) {
    METAEKF_ASSIGN_OR_RETURN(const double error, Error(arx.fit(context), recording));
    errors.back().push_back({error});
  }
  Table table = ToTable(labels, errors, scale.runs);
  Table times{.name = "times", .title = "Processor time", .row_heading = "learner", .columns = {{"training", "s"}}};
  for (size_t i = 0; i < learners.size(); ++i) times.rows.push_back({learners[i].label, {seconds[i]}});
  METAEKF_ASSIGN_OR_RETURN(Picture picture, Draw(table, learners.size()));
  std::vector<std::string> findings = Findings(table, learners.size());
  return Report{{std::move(table), std::move(times)}, std::move(findings), {std::move(picture)}};
}

}  // namespace

Experiment AnilHeatmap() {
  return {"anil-heatmap", "which layers should adapt, against the share of the target's data (van der Pol)", Protocol, Run};
}

}  // namespace metaekf::experiments
