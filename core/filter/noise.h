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
/// Second moments about zero, so that an offset counts as noise. In Case II what lasts of the errors of f and h is taken out of Q and R
/// (SplitByDuration); in Case I neighbouring latents have their windows in common, and residuals say nothing about that. A floor of 10⁻⁸
/// of each channel's variance keeps R positive definite where a model fits without error.
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
  /// Of residuals: sums of e_{t+k} e_tᵀ, and how many, for k = 0 … kLags.
  struct Moments {
    std::vector<Eigen::MatrixXd> sums;
    std::vector<int64_t> counts;
    void Add(const Eigen::MatrixXd& residuals);  // of one recording, a column a sample
    std::vector<Eigen::MatrixXd> Means() const;
  };
  Moments process_, measurement_;
  Eigen::MatrixXd fitted_;  // sum of covariances
  int64_t fitted_count_ = 0;
};

}  // namespace metaekf::filter
