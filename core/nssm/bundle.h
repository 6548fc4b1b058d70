#pragma once

#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/json_value.h"
#include "core/data/normaliser.h"
#include "core/nssm/model.h"
#include "core/nssm/prior.h"

namespace metaekf::nssm {

/// An error that lasts, e_t = W c_t with c_{t+1} = φ c_t + √(1 − φ²) ξ_t and c_0, ξ_t ~ N(0, I): a Gauss–Markov process of first order
/// with the covariance W Wᵀ.
struct GaussMarkov {
  Eigen::MatrixXd loadings;  ///< W, n × r; empty where there is no such error
  double correlation = 0;    ///< φ, of one sample with the next, from 0 to below 1
};

/// Covariances that a filter starts from, of the filter's own coordinates: physical units in Case II, latents in
/// Case I (R and outputs are physical in both).
struct FilterNoise {
  Eigen::MatrixXd process;      ///< Q, n × n
  Eigen::MatrixXd measurement;  ///< R, n_y × n_y
  Eigen::MatrixXd initial;      ///< covariance of the first state, n × n
  /// How far a system's own Q and R are from these: standard deviation of the logarithm of a variance over the fleet.
  double log_std = 1;
  /// ln of the factor by which variances that a system's context has led to must grow, so that bounds go on holding what those of the fleet hold.
  double own_widening = 0;
  /// Errors of f and h that last, beside Q and R, which do not: in Case II, where residuals show them.
  GaussMarkov process_bias, measurement_bias;
  /// Deviation of what an adaptation has left open of the parameters, in that of its posterior: a filter's own, whose model is not linear
  /// in them and whose errors are not all theirs.
  double parameter_std = 1;
};

struct ChannelNames {
  std::vector<std::string> inputs, outputs, states;
};

/// Everything that a model file holds: what is needed to use a model, and nothing else.
struct Bundle {
  Model model;
  std::vector<double> parameters;  ///< ω; values are float-exact where the spec says FLOAT32
  data::Normaliser normaliser;
  double sample_period_s = 0;
  ChannelNames names;
  FilterNoise noise;
  std::optional<GaussianPrior> prior;
  std::optional<GaussianPosterior> posterior;  ///< of a model adapted by Levenberg–Marquardt
  /// Specification of the training, as JSON: `adapt` takes its defaults from it.
  base::JsonValue training;
  /// Where the model comes from: seed, data digest, losses.
  base::JsonValue provenance;
};

/// Checks that a trajectory has the channels the model needs, and as many.
/// @param need_states  whether the whole of x is read (Case II).
/// Errors: InvalidArgument naming the channels that are missing.
absl::Status CheckChannels(const Bundle& bundle, const data::Trajectory& trajectory, bool need_states);

/// Rounds to the precision of the spec.
void RoundToPrecision(Precision precision, std::vector<double>* values);

}  // namespace metaekf::nssm
