#pragma once

#include <memory>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/rng.h"
#include "core/data/trajectory.h"
#include "core/filter/ekf.h"
#include "core/nssm/bundle.h"

namespace metaekf::experiments {

/// What an EKF has said of a recording, a column per sample. Physical units.
struct FilterRun {
  Eigen::MatrixXd means, deviations;  ///< of every state, after the sample's measurement
  Eigen::VectorXd nis;
  Eigen::VectorXd projection;  ///< how far estimates were moved into the model's set, in scales of the states; NaN without one
  std::vector<filter::Health> health;
  double seconds_per_step = 0;  ///< of the processor
};

/// The model adapted to the first `context_samples` of a recording as its training says, with the noise that it found there.
/// Errors: those of meta::Adapt.
absl::StatusOr<nssm::Bundle> AdaptForFilter(const nssm::Bundle& model, const data::Trajectory& recording, int64_t context_samples);

/// Estimates states (Case I: outputs) in `recording` from sample `from` on, where the samples before are the context. Its states were
/// measured in Case II: the filter begins there with x⁻ = f(x_{from−1}, u_{from−1}) and P⁻ = Q. In Case I the context's last samples
/// fill its window.
///
/// @param model  with the parameters and the noise that the filter is to use. @param functions  of its architecture. @param recording  T samples; n_x states in Case II.
/// @param from  at least 1. @param options  of the filter, without its beginning.
/// Errors: those of filter::Ekf.
absl::StatusOr<FilterRun> FilterAfterContext(const nssm::Bundle& model, const std::shared_ptr<const filter::FilterModel>& functions,
                                             const data::Trajectory& recording, int64_t from, filter::FilterOptions options = {});

/// What bounds of ± `width` standard deviations of the filter that FilterAfterContext runs would hold if it were right about its errors
/// (filter::BelievedErrors): of each of `draws`, the share. Other arguments and errors as those of FilterAfterContext.
absl::StatusOr<std::vector<double>> CoverageByChance(const nssm::Bundle& model, const std::shared_ptr<const filter::FilterModel>& functions,
                                                     const data::Trajectory& recording, int64_t from, double width, int draws, const base::Rng& rng);

/// Share of the errors that bounds of ± `width` standard deviations hold. @param errors  of the means.
double Coverage(const FilterRun& run, const Eigen::MatrixXd& errors, double width);

}  // namespace metaekf::experiments
