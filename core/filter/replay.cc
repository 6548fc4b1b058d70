#include "core/filter/replay.h"

#include <cmath>
#include <utility>

#include "core/base/status.h"

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;
using Eigen::VectorXd;

namespace {

const MatrixXd* Noise(const Sample& sample) { return sample.measurement_cov ? &*sample.measurement_cov : nullptr; }

/// Puts the measured components of `output` into a sample that may have others.
void Merge(const Ref<const VectorXd>& output, const MatrixXd* measurement_cov, const MatrixXd& usual_cov, Sample* sample) {
  if (measurement_cov != nullptr && !sample->measurement_cov) sample->measurement_cov = usual_cov;
  for (Index i = 0; i < output.size(); ++i) {
    if (std::isnan(output[i])) continue;
    sample->output[i] = output[i];
    if (!sample->measurement_cov) continue;
    const MatrixXd& own = measurement_cov != nullptr ? *measurement_cov : usual_cov;
    for (Index j = 0; j < output.size(); ++j) {
      // Measured at another time by another sensor: errors that have nothing to do with each other.
      const double shared = std::isnan(output[j]) ? 0 : own(i, j);
      (*sample->measurement_cov)(i, j) = (*sample->measurement_cov)(j, i) = shared;
    }
  }
}

}  // namespace

absl::Status ReplayFilter::Step(const Ref<const VectorXd>& input, const Ref<const VectorXd>& output,
                                FilterModel::Scratch* scratch, Estimate* estimate, const MatrixXd* measurement_cov) {
  if (lag_ == 0) return ekf_.Step(input, output, scratch, estimate, measurement_cov);
  Entry entry{.before = ekf_.state(), .sample = {.input = input, .output = output}};
  if (measurement_cov != nullptr) entry.sample.measurement_cov = *measurement_cov;
  METAEKF_RETURN_IF_ERROR(ekf_.Step(input, output, scratch, estimate, measurement_cov));
  entries_.push_back(std::move(entry));
  if (remembered() > lag_ + 1) entries_.pop_front();
  return absl::OkStatus();
}

absl::Status ReplayFilter::StepDelayed(int64_t back, const Ref<const VectorXd>& output, FilterModel::Scratch* scratch,
                                       Estimate* estimate, const MatrixXd* measurement_cov) {
  const size_t at = static_cast<size_t>(remembered() - 1 - back);
  const FilterState now = ekf_.state();
  Sample merged = entries_[at].sample;
  Merge(output, measurement_cov, ekf_.MeasurementNoise(), &merged);
  ekf_.Restore(entries_[at].before);
  // The first step checks what is new; the others have been taken before.
  const absl::Status status = ekf_.Step(merged.input, merged.output, scratch, estimate, Noise(merged));
  if (!status.ok()) {
    ekf_.Restore(now);
    return status;
  }
  entries_[at].sample = std::move(merged);
  Estimate later = ekf_.MakeEstimate();
  for (size_t i = at + 1; i < entries_.size(); ++i) {
    entries_[i].before = ekf_.state();
    const Sample& sample = entries_[i].sample;
    METAEKF_RETURN_IF_ERROR(ekf_.Step(sample.input, sample.output, scratch, &later, Noise(sample)));
  }
  return absl::OkStatus();
}

std::vector<Sample> ReplayFilter::Samples() const {
  std::vector<Sample> samples;
  for (const Entry& entry : entries_) samples.push_back(entry.sample);
  return samples;
}

absl::Status ReplayFilter::Restore(FilterState oldest_state, const std::vector<Sample>& samples,
                                   FilterModel::Scratch* scratch) {
  entries_.clear();
  ekf_.Restore(std::move(oldest_state));
  Estimate estimate = ekf_.MakeEstimate();
  for (const Sample& sample : samples) {
    METAEKF_RETURN_IF_ERROR(Step(sample.input, sample.output, scratch, &estimate, Noise(sample)));
  }
  return absl::OkStatus();
}

}  // namespace metaekf::filter
