#pragma once

#include <vector>

#include "absl/status/statusor.h"
#include "core/data/trajectory.h"
#include "core/nssm/bundle.h"

namespace metaekf::nssm {

enum class PredictionMode {
  kOneStep,   ///< y_t from measured y up to t−1 and u up to t, anew at every t
  kSimulate,  ///< measured outputs (Case II: the first state) only in the warm-up, then never again
};

/// Predictions of one trajectory in physical units. Column t is the prediction of sample t; the first `warmup`
/// columns are NaN.
struct Prediction {
  Eigen::MatrixXd outputs;  ///< ŷ, n_y × T
  Eigen::MatrixXd states;   ///< x̂, n_x × T; Case I: no rows
  int64_t warmup = 0;
};

/// Predicts a trajectory with a model.
///
///   one-step   Case I: ŷ_t = 𝓟𝓓y𝓐𝓔(window ending at t−1)    Case II: x̂_t = f(x_{t−1}, u_{t−1}), ŷ_t = h(x̂_t, u_t)
///   simulate   the same from the model's own predictions
///
/// @param trajectory  physical units, with the model's channels; Case II needs the measured states for kOneStep and
///                    the first of them for kSimulate.
/// Errors: InvalidArgument if channels disagree, FailedPrecondition if the trajectory is not longer than the warm-up.
absl::StatusOr<Prediction> Predict(const Bundle& bundle, const data::Trajectory& trajectory, PredictionMode mode);

/// How good predictions are, pooled over trajectories.
struct Score {
  std::vector<double> rmse;         ///< per channel, in its unit
  std::vector<double> fit_percent;  ///< 100 (1 − ‖y − ŷ‖ / ‖y − ȳ‖)
  int64_t samples = 0;              ///< predicted samples, warm-ups not counted
};

/// Scores signals against predictions of them; columns that are NaN in either are left out, channel by channel.
Score ScorePredictions(const std::vector<Eigen::MatrixXd>& measured, const std::vector<Eigen::MatrixXd>& predicted);

}  // namespace metaekf::nssm
