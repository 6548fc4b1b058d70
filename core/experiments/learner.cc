#include "core/experiments/learner.h"

#include <algorithm>
#include <chrono>
#include <limits>
#include <memory>
#include <utility>

#include "core/base/status.h"
#include "core/data/split.h"
#include "core/experiments/jobs.h"
#include "core/meta/adapt.h"

namespace metaekf::experiments {
namespace {

using data::Trajectory;
using Eigen::MatrixXd;

const char* NameOf(TrainingData data) {
  switch (data) {
    case TrainingData::kFleet:
      return "fleet";
    case TrainingData::kFleetAndContext:
      return "fleet and context";
    case TrainingData::kContext:
      return "context";
  }
  return "";
}

absl::Status CheckWarmup(const SystemModel& model, int64_t from) {
  if (from >= model.warmup) return absl::OkStatus();
  return absl::FailedPreconditionError(
      absl::StrCat("predictions from sample ", from, " on need a warm-up of ", model.warmup, " samples"));
}

absl::StatusOr<Trajectory> Cut(const Trajectory& recording, int64_t first, int64_t count) {
  METAEKF_ASSIGN_OR_RETURN(const Trajectory rest, data::SamplesFrom(recording, first));
  return data::FirstSamples(rest, std::min<int64_t>(count, rest.length()));
}

}  // namespace

nlohmann::json ToJson(const Learner& learner) {
  return {{"label", learner.label}, {"trained_on", NameOf(learner.data)}, {"specification", learner.specification}};
}

absl::StatusOr<nssm::Bundle> TrainLearner(const Learner& learner, const data::Dataset& fleet, const Trajectory& context,
                                          uint64_t seed, base::Executor* executor, const meta::OnTrainingStep& on_step) {
  nlohmann::json specification = learner.specification;
  specification["seed"] = seed;
  METAEKF_ASSIGN_OR_RETURN(const meta::TrainingSpec spec, meta::ReadTrainingSpec(specification));
  data::Dataset data = fleet;
  if (learner.data == TrainingData::kContext) data.trajectories.clear();
  if (learner.data != TrainingData::kFleet) {
    data.trajectories.push_back(context);
    data.trajectories.back().name = "target";
  }
  absl::StatusOr<nssm::Bundle> bundle = meta::Train(spec, data, nullptr, executor, on_step);
  if (!bundle.ok()) return base::Annotate(bundle.status(), learner.label);
  return bundle;
}

absl::StatusOr<std::vector<Training>> TrainAll(const std::vector<Learner>& learners, const data::Dataset& fleet,
                                               const data::Trajectory& context, uint64_t seed, base::Executor* executor,
                                               const OnProgress& on_progress) {
  using Clock = std::chrono::steady_clock;
  std::vector<Training> trainings;
  for (const Learner& learner : learners) {
    const auto tell = [&](int32_t iteration, int32_t iterations) {
      const std::string what = absl::StrCat("training ", learner.label, " (", trainings.size() + 1, " of ", learners.size(), ")");
      return !on_progress || on_progress(static_cast<size_t>(iteration), static_cast<size_t>(iterations), what);
    };
    const PeakMemory memory;
    const Clock::time_point begin = Clock::now();
    absl::StatusOr<nssm::Bundle> bundle =
        TrainLearner(learner, fleet, context, seed, executor, [&tell](const meta::TrainingProgress& step) {
          return tell(step.state.iteration, step.iterations);
        });
    if (!bundle.ok() && !IsDivergence(bundle.status())) return bundle.status();
    const double seconds = std::chrono::duration<double>(Clock::now() - begin).count();
    trainings.push_back({std::move(bundle), seconds, memory.MiB()});
  }
  return trainings;
}

void AddCosts(const Training& training, Row* row) {
  row->cells[0].push_back(training.bundle.ok() ? static_cast<double>(training.bundle->parameters.size()) : std::numeric_limits<double>::infinity());
  row->cells[1].push_back(training.seconds);
  row->cells[2].push_back(training.memory_mib);
}

SystemModel ModelOf(const nssm::Bundle& bundle) {
  const auto shared = std::make_shared<const nssm::Bundle>(bundle);
  const auto predict = [shared](const Trajectory& recording, nssm::PredictionMode mode) -> absl::StatusOr<MatrixXd> {
    METAEKF_ASSIGN_OR_RETURN(nssm::Prediction prediction, nssm::Predict(*shared, recording, mode));
    return shared->model.spec().is_case_one() ? std::move(prediction.outputs) : std::move(prediction.states);
  };
  return {.warmup = bundle.model.spec().warmup(), .predict = predict};
}

bool IsDivergence(const absl::Status& status) { return absl::IsOutOfRange(status); }

absl::StatusOr<SystemModel> AdaptToContext(const nssm::Bundle& bundle, const Trajectory& context) {
  METAEKF_ASSIGN_OR_RETURN(const meta::AdaptationOptions options, meta::DefaultAdaptation(bundle));
  nssm::Bundle adapted = bundle;
  // Levenberg–Marquardt without a step still chooses the most probable of the fleet's fits.
  if (options.inner_loop.steps > 0 || options.method == meta::AdaptationMethod::kLevenbergMarquardt) {
    METAEKF_ASSIGN_OR_RETURN(adapted, meta::AdaptedBundle(bundle, context, options));
  }
  return ModelOf(adapted);
}

absl::StatusOr<MatrixXd> PredictFreely(const SystemModel& model, const Trajectory& recording, int64_t from) {
  return PredictInBlocks(model, recording, from, recording.length() - from);
}

absl::StatusOr<MatrixXd> PredictInBlocks(const SystemModel& model, const Trajectory& recording, int64_t from,
                                         int64_t horizon) {
  METAEKF_RETURN_IF_ERROR(CheckWarmup(model, from));
  MatrixXd predictions;
  for (int64_t first = from; first < recording.length(); first += horizon) {
    METAEKF_ASSIGN_OR_RETURN(const Trajectory piece, Cut(recording, first - model.warmup, model.warmup + horizon));
    METAEKF_ASSIGN_OR_RETURN(const MatrixXd block, model.predict(piece, nssm::PredictionMode::kSimulate));
    if (predictions.size() == 0) predictions.resize(block.rows(), recording.length() - from);
    const Eigen::Index columns = piece.length() - model.warmup;
    predictions.middleCols(first - from, columns) = block.rightCols(columns);
  }
  return predictions;
}

std::vector<double> RowOf(const MatrixXd& matrix, Eigen::Index row) {
  std::vector<double> values(static_cast<size_t>(matrix.cols()));
  for (size_t t = 0; t < values.size(); ++t) values[t] = matrix(row, static_cast<Eigen::Index>(t));
  return values;
}

}  // namespace metaekf::experiments
