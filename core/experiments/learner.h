#pragma once

#include <functional>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/executor.h"
#include "core/data/trajectory.h"
#include "core/experiments/experiment.h"
#include "core/meta/train.h"
#include "core/nssm/predict.h"

namespace metaekf::experiments {

/// What a learner sees in training, of the fleet and of the system that it is made for.
enum class TrainingData { kFleet, kFleetAndContext, kContext };

/// A way to come by a neural model of a system: training, then adaptation to the context as the specification says
/// (`adaptation.steps` 0: none; of LEVENBERG_MARQUARDT under a learned prior: the most probable of the fleet's fits).
struct Learner {
  std::string label;
  TrainingData data = TrainingData::kFleet;
  nlohmann::json specification;  ///< TrainingSpec, less the seed
};

nlohmann::json ToJson(const Learner& learner);

/// @param context  of the target system; used unless the learner trains on the fleet alone.
/// Errors: those of meta::Train, beginning with the label.
absl::StatusOr<nssm::Bundle> TrainLearner(const Learner& learner, const data::Dataset& fleet, const data::Trajectory& context,
                                          uint64_t seed, base::Executor* executor, const meta::OnTrainingStep& on_step = nullptr);

/// What a training has brought, and what it took.
struct Training {
  absl::StatusOr<nssm::Bundle> bundle;  ///< OutOfRange if it diverged
  double seconds = 0;     ///< on the wall
  double memory_mib = 0;  ///< at its peak
};

/// Trains every learner on the fleet, one after the other with all threads. One that diverges does not stop the others.
/// @param context  of the target, for learners that train on it too.
absl::StatusOr<std::vector<Training>> TrainAll(const std::vector<Learner>& learners, const data::Dataset& fleet,
                                               const data::Trajectory& context, uint64_t seed, base::Executor* executor,
                                               const OnProgress& on_progress);

/// Adds one training to the first three cells of a row: its parameters, seconds and MiB.
void AddCosts(const Training& training, Row* row);

/// A model of one system, neural or not.
struct SystemModel {
  int64_t warmup = 0;  ///< samples needed before the first prediction
  /// Predictions of a recording in its unit, one column per sample, NaN in the warm-up: of the states where the model
  /// has some, else of the outputs.
  std::function<absl::StatusOr<Eigen::MatrixXd>(const data::Trajectory&, nssm::PredictionMode)> predict;
};

SystemModel ModelOf(const nssm::Bundle& bundle);

/// Whether a model has diverged, in training or adaptation: its run has failed, and no more. Other errors end a study.
bool IsDivergence(const absl::Status& status);

/// Adapts as the specification that the model was trained with says. Errors: those of meta::AdaptedBundle.
absl::StatusOr<SystemModel> AdaptToContext(const nssm::Bundle& bundle, const data::Trajectory& context);

/// Predictions of the samples `from` … T − 1, n × (T − from).
///
/// FreeRun: measured values up to from − 1, never again. In blocks: measured values up to the beginning of each block of
/// `horizon` samples, so that the last of a block is predicted that many steps ahead.
/// Errors: FailedPrecondition if `from` is below the warm-up.
absl::StatusOr<Eigen::MatrixXd> PredictFreely(const SystemModel& model, const data::Trajectory& recording, int64_t from);
absl::StatusOr<Eigen::MatrixXd> PredictInBlocks(const SystemModel& model, const data::Trajectory& recording, int64_t from,
                                                int64_t horizon);

/// A row of predictions or states, as a plot takes it.
std::vector<double> RowOf(const Eigen::MatrixXd& matrix, Eigen::Index row);

}  // namespace metaekf::experiments
