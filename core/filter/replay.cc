#include "core/filter/replay.h"

#include <cmath>
#include <utility>

#include "absl/container/inlined_vector.h"
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
  METAEKF_RETURN_IF_ERROR(ekf_.CheckSizes(input.size(), output.size()));
  NextReplaySample sample{this, input.data(), output.data(), measurement_cov, estimate, absl::OkStatus()};
  StepTogether({&sample, 1}, scratch);
  return sample.status;
}

void StepTogether(std::span<NextReplaySample> samples, FilterModel::Scratch* scratch) {
  absl::InlinedVector<NextSample, 8> steps;
  for (const NextReplaySample& s : samples) {
    s.filter->Remember(s);
    steps.push_back({&s.filter->ekf_, s.input, s.output, s.measurement_cov, s.estimate, absl::OkStatus()});
  }
  StepTogether(std::span<NextSample>(steps), scratch);
  for (size_t i = 0; i < steps.size(); ++i) {
    samples[i].status = std::move(steps[i].status);
    ReplayFilter* const filter = samples[i].filter;
    if (filter->lag_ == 0) continue;
    if (!samples[i].status.ok()) {
      filter->entries_.pop_back();
    } else if (filter->remembered() > filter->lag_ + 1) {
      filter->entries_.pop_front();
    }
  }
}

void ReplayFilter::Remember(const NextReplaySample& next) {
  if (lag_ == 0) return;
  Entry entry{.before = ekf_.state(),
              .sample = {.input = Eigen::Map<const VectorXd>(next.input, ekf_.input_size()), .output = Eigen::Map<const VectorXd>(next.output, ekf_.output_size())}};
  if (next.measurement_cov != nullptr) entry.sample.measurement_cov = *next.measurement_cov;
  entries_.push_back(std::move(entry));
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
