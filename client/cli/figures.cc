#include "client/cli/figures.h"

#include <cmath>
#include <utility>

#include "client/cli/progress.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

/// Σ f(y, ŷ) over the samples that have both.
template <typename Function>
double Sum(const std::vector<data::Trajectory>& trajectories,
           const std::vector<Predicted>& predictions, Eigen::Index first, Eigen::Index output,
           Function function) {
  double sum = 0;
  for (size_t i = 0; i < trajectories.size(); ++i) {
    for (Eigen::Index t = first; t < trajectories[i].length(); ++t) {
      const double y = trajectories[i].outputs(output, t);
      const double y_hat = predictions[i].outputs(output, t);
      if (!std::isnan(y) && !std::isnan(y_hat)) sum += function(y, y_hat);
    }
  }
  return sum;
}

absl::StatusOr<Eigen::MatrixXd> ToMatrix(const std::vector<double>& values, Eigen::Index samples) {
  const Eigen::Index size = static_cast<Eigen::Index>(values.size());
  if (samples == 0 || size % samples != 0) {
    return absl::InternalError(absl::StrCat("the server answered ", size, " values for ", samples,
                                            " samples; is it of another version?"));
  }
  return Eigen::MatrixXd(Eigen::Map<const Eigen::MatrixXd>(values.data(), size / samples, samples));
}

}  // namespace

ErrorFigures Score(const std::vector<data::Trajectory>& trajectories,
                   const std::vector<Predicted>& predictions, Eigen::Index first) {
  ErrorFigures figures;
  for (const Predicted& predicted : predictions) {
    for (Eigen::Index t = first; t < predicted.outputs.cols(); ++t) {
      figures.samples += !predicted.outputs.col(t).array().isNaN().all();
    }
  }
  const Eigen::Index outputs = predictions.empty() ? 0 : predictions.front().outputs.rows();
  for (Eigen::Index k = 0; k < outputs; ++k) {
    const auto sum = [&](auto function) {
      return Sum(trajectories, predictions, first, k, function);
    };
    const double count = sum([](double, double) { return 1.0; });
    const double mean = sum([](double y, double) { return y; }) / count;
    const double squares = sum([](double y, double y_hat) { return (y - y_hat) * (y - y_hat); });
    const double spread = sum([mean](double y, double) { return (y - mean) * (y - mean); });
    figures.rmse.push_back(std::sqrt(squares / count));
    figures.fit_percent.push_back(spread > 0 ? 100 * (1 - std::sqrt(squares / spread))
                                             : std::nan(""));
  }
  return figures;
}

absl::StatusOr<std::vector<Predicted>> Predict(Console& console, const TargetModel& model,
                                               client::PredictionMode mode,
                                               const std::vector<data::Trajectory>& trajectories) {
  uint64_t total = 0;
  for (const data::Trajectory& trajectory : trajectories) {
    total += static_cast<uint64_t>(trajectory.length());
  }
  Progress bar(console, "predicting");
  METAEKF_ASSIGN_OR_RETURN(
      const std::vector<client::Prediction> answers,
      ToAbsl(console.client().Predict(
          {.target = model.target, .mode = mode, .trajectories = ToClient(trajectories)},
          [&](uint64_t samples) { bar.Update(samples, total, {}, ""); })));
  std::vector<Predicted> predictions;
  for (size_t i = 0; i < answers.size(); ++i) {
    const Eigen::Index samples = trajectories[i].length();
    Predicted& predicted = predictions.emplace_back();
    METAEKF_ASSIGN_OR_RETURN(predicted.outputs, ToMatrix(answers[i].outputs, samples));
    METAEKF_ASSIGN_OR_RETURN(predicted.states, ToMatrix(answers[i].states, samples));
    predicted.warmup = answers[i].warmup_samples;
    if (predicted.outputs.rows() != trajectories[i].outputs.rows()) {
      return absl::InternalError(absl::StrCat("the server predicted ", predicted.outputs.rows(),
                                              " outputs, the data has ",
                                              trajectories[i].outputs.rows()));
    }
  }
  return predictions;
}

}  // namespace metaekf::cli
