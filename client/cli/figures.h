#pragma once

#include <Eigen/Core>
#include <vector>

#include "absl/status/statusor.h"
#include "client/cli/data_files.h"

namespace metaekf::cli {

/// Predictions of one recording, one column per sample, NaN where there is none.
struct Predicted {
  Eigen::MatrixXd outputs;
  Eigen::MatrixXd states;  ///< no rows in Case I
  Eigen::Index warmup = 0;
};

/// Errors of predictions, one value per output, pooled over trajectories:
///
///   RMSE = √(Σ (y − ŷ)² / N)      Fit = 100 (1 − ‖y − ŷ‖ / ‖y − ȳ‖) %
///
/// over the N samples with both y and ŷ; ȳ is the mean of y over them. NaN if N is 0; Fit also if y
/// does not vary.
struct ErrorFigures {
  std::vector<double> rmse;
  std::vector<double> fit_percent;
  Eigen::Index samples = 0;  ///< samples with a prediction
};

/// Scores predictions of `trajectories` (one each) from sample `first` of each on.
ErrorFigures Score(const std::vector<data::Trajectory>& trajectories,
                   const std::vector<Predicted>& predictions, Eigen::Index first = 0);

/// Predicts with the server, showing progress. Errors: those of the call; Internal if the answer
/// has another size than the data.
absl::StatusOr<std::vector<Predicted>> Predict(Console& console, const TargetModel& model,
                                               client::PredictionMode mode,
                                               const std::vector<data::Trajectory>& trajectories);

}  // namespace metaekf::cli
