#pragma once

#include <memory>
#include <vector>

#include "core/data/trajectory.h"
#include "core/filter/filter_model.h"

namespace metaekf::filter {

/// Residuals of models on recordings, summed up to the covariances a filter starts from.
///
///   Case II   Q = cov(x_{t+1} − f(x_t, u_t)),  R = cov(y_t − h(x_t, u_t)),  P₀ = the fleet's variance of x
///   Case I    Q = cov(𝓔(window at t+1) − 𝓐(𝓔(window at t), u)),  R = cov(y_t − 𝓓y𝓔(window at t)),  P₀ = Q,
///             where the start is fitted the mean posterior covariance of 𝓔
///
/// Second moments about zero, so that a bias counts as noise. A floor of 10⁻⁸ of each channel's variance keeps R positive
/// definite where a model fits without error.
class NoiseEstimate {
 public:
  /// @param bundle  must outlive the estimate; its noise is not read.
  explicit NoiseEstimate(const nssm::Bundle& bundle);

  /// Adds a recording in normalised units as predicted with `parameters`.
  void Add(const std::vector<double>& parameters, const data::Trajectory& normalised);

  /// In physical units (latents in Case I).
  nssm::FilterNoise Result(const data::Normaliser& normaliser) const;

 private:
  const nssm::Bundle& bundle_;
  std::unique_ptr<FilterModel> filter_model_;
  std::unique_ptr<FilterModel::Scratch> scratch_;
  Eigen::MatrixXd process_, measurement_, fitted_;  // sums of outer products and covariances, normalised units
  int64_t process_count_ = 0, measurement_count_ = 0, fitted_count_ = 0;
};

}  // namespace metaekf::filter
