#pragma once

#include <deque>
#include <optional>

#include "core/filter/ekf.h"

namespace metaekf::filter {

/// One period's sample.
struct Sample {
  Eigen::VectorXd input, output;                   ///< NaN in the output: not measured
  std::optional<Eigen::MatrixXd> measurement_cov;  ///< R of this sample; without it the filter's
};

class ReplayFilter;
using NextReplaySample = NextSampleOf<ReplayFilter>;

/// ReplayFilter::Step of filters on one FilterModel, as those of Ekf.
void StepTogether(std::span<NextReplaySample> samples, FilterModel::Scratch* scratch);

/// An Ekf that remembers its last samples with the states before them, so that a measurement that comes late is applied at its
/// own time: the filter goes back there and repeats all samples since. What it gives then is what it would have given had the
/// measurement come in time.
class ReplayFilter {
 public:
  /// @param lag  samples, the newest not counted, that a measurement may come late; 0: nothing is remembered.
  ReplayFilter(Ekf ekf, int64_t lag) : ekf_(std::move(ekf)), lag_(lag) {}

  /// As Ekf::Step, one period after the last sample.
  absl::Status Step(const Eigen::Ref<const Eigen::VectorXd>& input, const Eigen::Ref<const Eigen::VectorXd>& output,
                    FilterModel::Scratch* scratch, Estimate* estimate, const Eigen::MatrixXd* measurement_cov = nullptr);

  /// Applies a measurement of `back` periods before the newest sample, 0 ≤ back < remembered(). A component that has been measured
  /// then already is replaced. @param estimate  of that time. Errors as those of Ekf::Step; the filter is unchanged then.
  absl::Status StepDelayed(int64_t back, const Eigen::Ref<const Eigen::VectorXd>& output, FilterModel::Scratch* scratch,
                           Estimate* estimate, const Eigen::MatrixXd* measurement_cov = nullptr);

  int64_t lag() const { return lag_; }
  /// Samples that StepDelayed can go back to, the newest included; at most lag() + 1.
  int64_t remembered() const { return static_cast<int64_t>(entries_.size()); }
  const Ekf& ekf() const { return ekf_; }

  /// What a checkpoint must hold: the state before the oldest sample that is remembered, and the samples since. Without any, the
  /// state of the filter.
  const FilterState& oldest_state() const { return entries_.empty() ? ekf_.state() : entries_.front().before; }
  std::vector<Sample> Samples() const;
  /// Goes on from such a checkpoint of a filter of the same model, options and lag. Errors as those of Ekf::Step.
  absl::Status Restore(FilterState oldest_state, const std::vector<Sample>& samples, FilterModel::Scratch* scratch);

 private:
  friend void StepTogether(std::span<NextReplaySample> samples, FilterModel::Scratch* scratch);
  struct Entry {
    FilterState before;
    Sample sample;
  };
  void Remember(const NextReplaySample& next);

  Ekf ekf_;
  int64_t lag_;
  std::deque<Entry> entries_;
};

}  // namespace metaekf::filter
