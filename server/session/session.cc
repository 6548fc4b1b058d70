#include "server/session/session.h"

#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "server/convert/channels.h"
#include "server/status/details.h"

namespace metaekf::server {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using v1::EstimateBatch;
using v1::OpenSession;

constexpr double kTimeTolerance = 0.1;     // periods that a time may be off the grid
constexpr int64_t kMaxMissedPeriods = 100'000;
constexpr uint64_t kCheckpointVersion = 1;

/// n values are a diagonal, n(n+1)/2 a lower triangle row by row. For n = 1 both are the same.
absl::StatusOr<MatrixXd> ReadCovariance(const std::string& field, const google::protobuf::RepeatedField<double>& values,
                                        Index n) {
  MatrixXd cov = MatrixXd::Zero(n, n);
  const Index count = values.size();
  if (count != n && count != n * (n + 1) / 2) {
    return FieldViolation(field, absl::StrCat("expected ", n, " values (the diagonal) or ", n * (n + 1) / 2,
                                              " (the lower triangle row by row), got ", count));
  }
  for (Index i = 0, at = 0; i < n; ++i) {
    if (count == n) {
      cov(i, i) = values[static_cast<int>(i)];
      continue;
    }
    for (Index j = 0; j <= i; ++j, ++at) cov(i, j) = cov(j, i) = values[static_cast<int>(at)];
  }
  return cov;
}

absl::StatusOr<filter::FilterOptions> ReadNoise(const v1::NoiseSettings& noise, Index n, Index n_y) {
  filter::FilterOptions options;
  if (!noise.process_noise_cov().empty()) {
    METAEKF_ASSIGN_OR_RETURN(options.process_cov,
                             ReadCovariance("open.noise.process_noise_cov", noise.process_noise_cov(), n));
  }
  if (!noise.measurement_noise_cov().empty()) {
    METAEKF_ASSIGN_OR_RETURN(options.measurement_cov,
                             ReadCovariance("open.noise.measurement_noise_cov", noise.measurement_noise_cov(), n_y));
  }
  if (!noise.initial_cov().empty()) {
    METAEKF_ASSIGN_OR_RETURN(options.initial_cov, ReadCovariance("open.noise.initial_cov", noise.initial_cov(), n));
  }
  if (!noise.initial_mean().empty()) {
    options.initial_mean = Eigen::Map<const VectorXd>(noise.initial_mean().data(), noise.initial_mean().size());
  }
  return options;
}

EstimateBatch::Health ToMessage(filter::Health health) {
  switch (health) {
    case filter::Health::kWarmingUp:
      return EstimateBatch::WARMING_UP;
    case filter::Health::kConsistent:
      return EstimateBatch::CONSISTENT;
    case filter::Health::kInconsistent:
      return EstimateBatch::INCONSISTENT;
    case filter::Health::kDiverged:
      return EstimateBatch::DIVERGED;
  }
  return EstimateBatch::HEALTH_UNSPECIFIED;
}

void AddLowerTriangle(const MatrixXd& matrix, google::protobuf::RepeatedField<double>* values) {
  for (Index i = 0; i < matrix.rows(); ++i) {
    for (Index j = 0; j <= i; ++j) values->Add(matrix(i, j));
  }
}

uint64_t Fnv1a(const char* data, size_t size) {
  uint64_t hash = 0xcbf29ce484222325;
  for (size_t i = 0; i < size; ++i) hash = (hash ^ static_cast<unsigned char>(data[i])) * 0x100000001b3;
  return hash;
}

/// Words of 8 bytes, one after the other.
class Words {
 public:
  Words() = default;
  explicit Words(const std::string& bytes) : bytes_(bytes) {}

  template <typename T>
  void Put(T value) {
    static_assert(sizeof(T) == 8);
    bytes_.append(reinterpret_cast<const char*>(&value), 8);
  }
  template <typename T>
  T Take() {
    static_assert(sizeof(T) == 8);
    T value{};
    if (at_ + 8 <= bytes_.size()) std::memcpy(&value, bytes_.data() + at_, 8);
    at_ += 8;
    return value;
  }
  bool AtEnd() const { return at_ == bytes_.size(); }
  const std::string& bytes() const { return bytes_; }

 private:
  std::string bytes_;
  size_t at_ = 0;
};

}  // namespace

absl::StatusOr<std::unique_ptr<Session>> Session::Open(std::shared_ptr<const ServedModel> model,
                                                       const OpenSession& open) {
  const nssm::Bundle& bundle = model->bundle;
  if (open.max_lag_s() != 0) {
    return FieldViolation("open.max_lag_s", "delayed measurements are not supported by this server: leave it 0");
  }
  const double period = open.sample_period_s();
  if (period != 0 && !(std::fabs(period - bundle.sample_period_s) <= 1e-6 * bundle.sample_period_s)) {
    return FieldViolation("open.sample_period_s", absl::StrCat("the model has a period of ", base::FormatExact(bundle.sample_period_s),
                                                               " s, got ", base::FormatExact(period), " s"));
  }
  if (open.has_channels()) {
    METAEKF_RETURN_IF_ERROR(MatchChannels("open.channels", open.channels(), bundle).status());
  }
  METAEKF_ASSIGN_OR_RETURN(const filter::FilterOptions options,
                           ReadNoise(open.noise(), model->filter_model->state_size(), bundle.model.spec().output_size));
  absl::StatusOr<filter::Ekf> ekf = filter::Ekf::Create(bundle, model->filter_model, model->filter_parameters, options);
  if (!ekf.ok()) return FieldViolation("open.noise", std::string(ekf.status().message()));
  return std::unique_ptr<Session>(new Session(std::move(model), *std::move(ekf), open));
}

Session::Session(std::shared_ptr<const ServedModel> model, filter::Ekf ekf, const OpenSession& open)
    : model_(std::move(model)),
      ekf_(std::move(ekf)),
      estimate_(ekf_.MakeEstimate()),
      covariance_format_(open.covariance_format() == OpenSession::COVARIANCE_FORMAT_UNSPECIFIED
                             ? OpenSession::NONE
                             : open.covariance_format()),
      send_innovations_(open.send_innovations()),
      period_s_(model_->bundle.sample_period_s) {}

void Session::Describe(v1::SessionOpened* opened) const {
  const nssm::Bundle& bundle = model_->bundle;
  opened->set_model_version(model_->model_version);
  opened->set_adaptation(model_->adaptation);
  opened->set_input_size(static_cast<uint32_t>(ekf_.input_size()));
  opened->set_output_size(static_cast<uint32_t>(ekf_.output_size()));
  opened->set_estimate_size(static_cast<uint32_t>(ekf_.estimate_size()));
  for (const std::string& name : bundle.model.spec().is_case_one() ? bundle.names.outputs : bundle.names.states) {
    opened->add_estimated()->set_name(name);
  }
  opened->set_sample_period_s(period_s_);
  opened->set_covariance_format(covariance_format_);
  opened->set_send_innovations(send_innovations_);
  opened->set_constrained(ekf_.constrained());
}

absl::Status Session::Check(const v1::SampleBatch& batch, int64_t rows) const {
  const int64_t n_u = ekf_.input_size(), n_y = ekf_.output_size();
  if (batch.outputs_size() % n_y != 0) {
    return FieldViolation("samples.outputs", absl::StrCat(batch.outputs_size(), " values are no whole rows of ", n_y));
  }
  if (batch.inputs_size() != rows * n_u) {
    return FieldViolation("samples.inputs", absl::StrCat("expected ", rows, " × ", n_u, " values, got ", batch.inputs_size()));
  }
  if (!batch.times_s().empty() && batch.times_s_size() != rows) {
    return FieldViolation("samples.times_s", absl::StrCat("expected ", rows, " values or none, got ", batch.times_s_size()));
  }
  for (int i = 0; i < batch.inputs_size(); ++i) {
    if (!std::isfinite(batch.inputs(i))) {
      return FieldViolation(absl::StrCat("samples.inputs[", i, "]"), absl::StrCat("must be finite, got ", base::FormatExact(batch.inputs(i))));
    }
  }
  for (int i = 0; i < batch.outputs_size(); ++i) {
    if (std::isinf(batch.outputs(i))) {
      return FieldViolation(absl::StrCat("samples.outputs[", i, "]"),
                            absl::StrCat("must be finite, or NaN if not measured, got ", base::FormatExact(batch.outputs(i))));
    }
  }
  if (batch.first_seq() == 0) return FieldViolation("samples.first_seq", "samples are numbered from 1");
  if (batch.first_seq() > seq_ + 1) {
    return WithReason(absl::OutOfRangeError(absl::StrCat("samples.first_seq: expected ", seq_ + 1, ", got ", batch.first_seq())),
                      "SEQUENCE_GAP", {{"expected_seq", absl::StrCat(seq_ + 1)}});
  }
  double last = time_s_;
  for (int64_t row = 0; row < batch.times_s_size(); ++row) {
    const double time = batch.times_s(static_cast<int>(row));
    if (!std::isfinite(time)) {
      return FieldViolation(absl::StrCat("samples.times_s[", row, "]"), absl::StrCat("must be finite, got ", base::FormatExact(time)));
    }
    const uint64_t number = batch.first_seq() + static_cast<uint64_t>(row);
    if (number <= seq_) continue;
    if (number > 1) {
      const absl::Status status = PeriodsTo(time, last).status();
      if (!status.ok()) return FieldViolation(absl::StrCat("samples.times_s[", row, "]"), std::string(status.message()));
    }
    last = time;
  }
  return absl::OkStatus();
}

absl::StatusOr<int64_t> Session::PeriodsTo(double time_s, double last_time_s) const {
  const double periods = (time_s - last_time_s) / period_s_;
  const double whole = std::round(periods);
  if (whole < 1) {
    return absl::InvalidArgumentError(absl::StrCat("time runs backwards: ", base::FormatExact(time_s), " s after ",
                                                   base::FormatExact(last_time_s), " s"));
  }
  if (std::fabs(periods - whole) > kTimeTolerance || whole > static_cast<double>(kMaxMissedPeriods)) {
    return absl::InvalidArgumentError(absl::StrCat(base::FormatExact(time_s), " s is not a whole number of periods of ",
                                                   base::FormatExact(period_s_), " s after ", base::FormatExact(last_time_s), " s"));
  }
  return static_cast<int64_t>(whole);
}

absl::Status Session::Step(const double* input, const double* output, filter::FilterModel::Scratch* scratch) {
  return ekf_.Step(Eigen::Map<const VectorXd>(input, ekf_.input_size()),
                   Eigen::Map<const VectorXd>(output, ekf_.output_size()), scratch, &estimate_);
}

absl::Status Session::Apply(const v1::SampleBatch& batch, filter::FilterModel::Scratch* scratch,
                            EstimateBatch* estimates) {
  const int64_t n_u = ekf_.input_size(), n_y = ekf_.output_size();
  const int64_t rows = batch.outputs_size() / n_y;
  METAEKF_RETURN_IF_ERROR(Check(batch, rows));
  const std::vector<double> nothing(static_cast<size_t>(n_y), std::numeric_limits<double>::quiet_NaN());
  for (int64_t row = 0; row < rows; ++row) {
    const uint64_t number = batch.first_seq() + static_cast<uint64_t>(row);
    if (number <= seq_) continue;
    const double* input = batch.inputs().data() + row * n_u;
    const double* output = batch.outputs().data() + row * n_y;
    int64_t periods = 1;
    double time = batch.times_s().empty() ? (seq_ == 0 ? 0 : time_s_ + period_s_) : batch.times_s(static_cast<int>(row));
    if (seq_ > 0 && !batch.times_s().empty()) periods = *PeriodsTo(time, time_s_);
    // Periods without a sample: time passes, under the input that was last known.
    for (int64_t missed = 1; missed < periods; ++missed) {
      const VectorXd held = ekf_.LastInput();
      METAEKF_RETURN_IF_ERROR(Step(held.data(), nothing.data(), scratch));
    }
    METAEKF_RETURN_IF_ERROR(Step(input, output, scratch));
    if (estimates->times_s().empty()) estimates->set_first_seq(number);
    seq_ = number;
    time_s_ = time;
    Append(output, estimates);
  }
  return absl::OkStatus();
}

void Session::Append(const double* output, EstimateBatch* estimates) const {
  estimates->add_times_s(time_s_);
  estimates->mutable_means()->Add(estimate_.mean.begin(), estimate_.mean.end());
  if (covariance_format_ == OpenSession::DIAGONAL) {
    for (Index i = 0; i < estimate_.cov.rows(); ++i) estimates->add_covariances(estimate_.cov(i, i));
  } else if (covariance_format_ == OpenSession::LOWER_TRIANGLE) {
    AddLowerTriangle(estimate_.cov, estimates->mutable_covariances());
  }
  if (send_innovations_) {
    estimates->mutable_innovations()->Add(estimate_.innovation.begin(), estimate_.innovation.end());
    AddLowerTriangle(estimate_.innovation_cov, estimates->mutable_innovation_covs());
  }
  estimates->add_nis(estimate_.nis);
  estimates->add_health(ToMessage(estimate_.health));
  bool missing = false;
  for (int32_t i = 0; i < ekf_.output_size(); ++i) missing = missing || std::isnan(output[i]);
  uint32_t flags = missing ? EstimateBatch::MISSING : EstimateBatch::NO_FLAG;
  if (ekf_.constrained()) {
    if (estimate_.projection > 0) flags |= EstimateBatch::PROJECTED;
    estimates->add_slacks(estimate_.slack);
    estimates->add_projections(estimate_.projection);
  }
  estimates->add_flags(flags);
}

std::string Session::Checkpoint() const {
  const filter::FilterState& state = ekf_.state();
  Words words;
  words.Put(kCheckpointVersion);
  words.Put(seq_);
  words.Put(time_s_);
  words.Put(static_cast<int64_t>(state.samples));
  words.Put(state.nis_ratio);
  words.Put(static_cast<int64_t>(state.diverged));
  words.Put(static_cast<int64_t>(state.window.size()));
  for (const double value : state.mean) words.Put(value);
  for (Index i = 0; i < state.factor.size(); ++i) words.Put(state.factor.data()[i]);
  for (const double value : state.last_input) words.Put(value);
  for (const double value : state.window) words.Put(value);
  words.Put(Fnv1a(words.bytes().data(), words.bytes().size()));
  return words.bytes();
}

absl::Status Session::Restore(const std::string& checkpoint) {
  const absl::Status damaged = absl::DataLossError("the session's checkpoint is damaged");
  if (checkpoint.size() < 8) return damaged;
  Words checksum(checkpoint.substr(checkpoint.size() - 8));
  if (checksum.Take<uint64_t>() != Fnv1a(checkpoint.data(), checkpoint.size() - 8)) return damaged;
  Words words(checkpoint.substr(0, checkpoint.size() - 8));
  if (words.Take<uint64_t>() != kCheckpointVersion) {
    return absl::FailedPreconditionError("the session's checkpoint was written by another version of the server");
  }
  const uint64_t seq = words.Take<uint64_t>();
  const double time = words.Take<double>();
  filter::FilterState state = ekf_.state();
  state.samples = words.Take<int64_t>();
  state.nis_ratio = words.Take<double>();
  state.diverged = words.Take<int64_t>() != 0;
  const int64_t window = words.Take<int64_t>();
  if (window < 0 || window * 8 > static_cast<int64_t>(checkpoint.size())) return damaged;
  for (double& value : state.mean) value = words.Take<double>();
  for (Index i = 0; i < state.factor.size(); ++i) state.factor.data()[i] = words.Take<double>();
  for (double& value : state.last_input) value = words.Take<double>();
  state.window.clear();
  for (int64_t i = 0; i < window; ++i) state.window.push_back(words.Take<double>());
  if (!words.AtEnd()) return damaged;
  seq_ = seq;
  time_s_ = time;
  ekf_.Restore(std::move(state));
  return absl::OkStatus();
}

}  // namespace metaekf::server
