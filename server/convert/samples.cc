#include "server/convert/samples.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "server/status/details.h"

namespace metaekf::server {
namespace {

using Values = google::protobuf::RepeatedField<double>;

// Times in files are rounded, so periods taken from them differ a little.
constexpr double kPeriodTolerance = 1e-4;

void Append(const Values& values, size_t count, std::vector<double>* all) {
  if (values.empty()) {
    all->resize(all->size() + count, std::numeric_limits<double>::quiet_NaN());
  } else {
    all->insert(all->end(), values.begin(), values.end());
  }
}

/// Samples one after the other are columns one after the other.
Eigen::MatrixXd ToMatrix(int32_t rows, int64_t columns, std::vector<double>* values) {
  Eigen::MatrixXd matrix = Eigen::Map<const Eigen::MatrixXd>(values->data(), rows, columns);
  values->clear();
  return matrix;
}

}  // namespace

absl::Status SampleChecker::Add(const v1::Samples& samples) {
  if (samples.sample_count() == 0) {
    return FieldViolation("samples.sample_count", "is 0; send at least one sample per message");
  }
  if (recordings_.empty() || samples.trajectory() != recordings_.back().name) {
    METAEKF_RETURN_IF_ERROR(Begin(samples));
  }
  const uint32_t rows = samples.sample_count();
  METAEKF_RETURN_IF_ERROR(
      CheckMatrix("input", rules_.channels.inputs, false, samples.inputs(), rows));
  METAEKF_RETURN_IF_ERROR(
      CheckMatrix("output", rules_.channels.outputs, true, samples.outputs(), rows));
  METAEKF_RETURN_IF_ERROR(
      CheckMatrix("state", rules_.channels.states, true, samples.states(), rows));
  recordings_.back().samples += rows;
  total_samples_ += rows;
  if (total_samples_ > rules_.max_samples) {
    return absl::ResourceExhaustedError(absl::StrCat(
        "more than ", rules_.max_samples, " samples in one call, this server's limit; send fewer"));
  }
  return absl::OkStatus();
}

absl::Status SampleChecker::Begin(const v1::Samples& samples) {
  if (!names_.insert(samples.trajectory()).second) {
    return FieldViolation("samples.trajectory",
                          absl::StrCat("'", samples.trajectory(),
                                       "' goes on after another "
                                       "trajectory; send each as a whole under its own name"));
  }
  const double period = samples.sample_period_s();
  if (!std::isfinite(period) || period < 0 || !std::isfinite(samples.start_time_s())) {
    return FieldViolation("samples.sample_period_s",
                          absl::StrCat("trajectory '", samples.trajectory(),
                                       "': period and start time must be finite, the period not "
                                       "negative"));
  }
  const double expected = rules_.sample_period_s;
  if (period > 0 && expected > 0 && std::abs(period - expected) > kPeriodTolerance * expected) {
    return FieldViolation(
        "samples.sample_period_s",
        absl::StrCat("trajectory '", samples.trajectory(), "' has ", base::FormatShort(period),
                     " s, the model ", base::FormatShort(expected), " s; resample the data"));
  }
  recordings_.push_back({samples.trajectory(), 0, samples.start_time_s(), period});
  return absl::OkStatus();
}

absl::Status SampleChecker::CheckMatrix(const std::string& signal, int32_t width,
                                        bool is_measurement, const Values& values,
                                        uint32_t rows) const {
  const std::string field = absl::StrCat("samples.", signal, "s");
  const Recording& recording = recordings_.back();
  const bool may_miss = is_measurement && rules_.missing_measurements;
  if (values.empty() && may_miss) return absl::OkStatus();
  const uint64_t expected = uint64_t{rows} * static_cast<uint64_t>(width);
  if (static_cast<uint64_t>(values.size()) != expected) {
    return FieldViolation(
        field, absl::StrCat("trajectory '", recording.name, "', samples from ", recording.samples,
                            ": ", values.size(), " values, expected ", expected, " (", rows,
                            " samples of ", width, ")"));
  }
  for (int i = 0; i < values.size(); ++i) {
    const double value = values[i];
    if (std::isfinite(value) || (std::isnan(value) && may_miss)) continue;
    return FieldViolation(
        absl::StrCat(field, "[", i, "]"),
        absl::StrCat(
            "trajectory '", recording.name, "', sample ", recording.samples + i / width, ": ",
            signal, " ", i % width + 1, " is ", base::FormatExact(value),
            may_miss ? ", expected a finite number or NaN" : ", expected a finite number"));
  }
  return absl::OkStatus();
}

absl::StatusOr<std::optional<data::Trajectory>> TrajectoryAssembler::Add(
    const v1::Samples& samples) {
  std::optional<data::Trajectory> before;
  const bool begins =
      !checker_.recordings().empty() && samples.trajectory() != checker_.recordings().back().name;
  if (begins) before = Finish();
  METAEKF_RETURN_IF_ERROR(checker_.Add(samples));
  const ChannelCounts& channels = checker_.rules().channels;
  const size_t rows = samples.sample_count();
  Append(samples.inputs(), rows * static_cast<size_t>(channels.inputs), &inputs_);
  Append(samples.outputs(), rows * static_cast<size_t>(channels.outputs), &outputs_);
  Append(samples.states(), rows * static_cast<size_t>(channels.states), &states_);
  return before;
}

int64_t TrajectoryAssembler::BytesOf(const v1::Samples& samples) const {
  const SampleRules& rules = checker_.rules();
  const int64_t channels = rules.channels.inputs + rules.channels.outputs + rules.channels.states;
  const int64_t rows = std::min<int64_t>(samples.sample_count(), rules.max_samples);
  return 2 * rows * channels * static_cast<int64_t>(sizeof(double));  // as they came, and as matrices
}

std::optional<data::Trajectory> TrajectoryAssembler::Finish() {
  if (checker_.recordings().empty()) return std::nullopt;
  const SampleChecker::Recording& recording = checker_.recordings().back();
  const ChannelCounts& channels = checker_.rules().channels;
  data::Trajectory trajectory{.name = recording.name,
                              .start_s = recording.start_s,
                              .sample_period_s = recording.sample_period_s,
                              .inputs = ToMatrix(channels.inputs, recording.samples, &inputs_),
                              .outputs = ToMatrix(channels.outputs, recording.samples, &outputs_),
                              .states = ToMatrix(channels.states, recording.samples, &states_)};
  return trajectory;
}

}  // namespace metaekf::server
