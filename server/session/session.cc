#include "server/session/session.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/filter/square_root.h"
#include "server/convert/channels.h"
#include "server/session/checkpoint.h"
#include "server/session/read_options.h"
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
constexpr int64_t kMaxLag = 1000;              // periods
constexpr int64_t kMaxHorizon = 10'000;        // samples
constexpr int64_t kMaxRemembered = 64 << 20;   // bytes
constexpr int64_t kAnswerBytes = 1 << 20;      // after which the rest of a batch goes into the next
constexpr int64_t kForecastBytes = 4 << 20;    // more than which clients of gRPC refuse to receive

/// Periods that a measurement may come late. Errors: InvalidArgument for a lag that is negative or too long to remember.
absl::StatusOr<int64_t> ReadLag(const OpenSession& open, double period_s, const filter::Ekf& ekf) {
  const double periods = std::floor(open.max_lag_s() / period_s + kTimeTolerance);
  if (!(periods >= 0) || periods > kMaxLag) {
    return FieldViolation("open.max_lag_s", absl::StrCat("must be from 0 to ", kMaxLag, " sample periods (",
                                                         base::FormatShort(kMaxLag * period_s), " s), got ",
                                                         base::FormatExact(open.max_lag_s()), " s"));
  }
  const int64_t lag = static_cast<int64_t>(periods), bytes = 8 * ekf.state().factor.size();
  if (lag * bytes > kMaxRemembered) {
    return FieldViolation("open.max_lag_s", absl::StrCat("states of this model take ", bytes, " bytes; at most ", kMaxRemembered / bytes,
                                                         " sample periods can be remembered, got ", lag));
  }
  return lag;
}

/// R of one of the rows of a batch that brings them.
absl::StatusOr<MatrixXd> NoiseOf(const v1::SampleBatch& batch, int64_t rows, int64_t row, Index n_y) {
  const int64_t width = batch.measurement_noise_covs_size() / rows;
  if (width * rows != batch.measurement_noise_covs_size()) {
    return FieldViolation("samples.measurement_noise_covs", absl::StrCat(batch.measurement_noise_covs_size(), " values for ", rows,
                                                                         " samples"));
  }
  return ReadCovariance("samples.measurement_noise_covs", batch.measurement_noise_covs().data() + row * width, width, n_y);
}

/// No sensor and no unit is this far off, in scales of what the model was trained on: a filter could only diverge.
constexpr double kFarthest = 1e9;

absl::Status CheckValues(const char* field, const google::protobuf::RepeatedField<double>& values,
                         const data::ChannelScaling& scaling, bool may_be_missing) {
  for (int i = 0; i < values.size(); ++i) {
    const double value = values[i];
    if (may_be_missing && std::isnan(value)) continue;
    const Eigen::Index channel = i % scaling.mean.size();
    const bool finite = std::isfinite(value);
    if (finite && std::abs(value - scaling.mean[channel]) <= kFarthest * scaling.scale[channel]) continue;
    const char* missing = may_be_missing ? ", or NaN if it was not measured" : "";
    return FieldViolation(absl::StrCat(field, "[", i, "]"),
                          finite ? absl::StrCat("is ", base::FormatExact(value), ", more than 1e9 times as far from the mean as what the model was "
                                                "trained on; it must be a measured value in the model's unit", missing)
                                 : absl::StrCat("must be finite", missing, ", got ", base::FormatExact(value)));
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<std::unique_ptr<Session>> Session::Open(std::shared_ptr<const ServedModel> model,
                                                       const OpenSession& open) {
  const nssm::Bundle& bundle = model->bundle;
  const double period = open.sample_period_s();
  if (period != 0 && !(std::fabs(period - bundle.sample_period_s) <= 1e-6 * bundle.sample_period_s)) {
    return FieldViolation("open.sample_period_s", absl::StrCat("the model has a period of ", base::FormatExact(bundle.sample_period_s),
                                                               " s, got ", base::FormatExact(period), " s"));
  }
  if (open.has_channels()) {
    METAEKF_RETURN_IF_ERROR(MatchChannels("open.channels", open.channels(), bundle).status());
  }
  METAEKF_ASSIGN_OR_RETURN(
      const filter::FilterOptions options,
      ReadFilterOptions("open", open, model->filter_model->state_size(), bundle.model.spec().output_size));
  absl::StatusOr<filter::Ekf> ekf = filter::Ekf::Create(bundle, model->filter_model, model->filter_parameters, options);
  if (!ekf.ok()) return FieldViolation("open.noise", std::string(ekf.status().message()));
  METAEKF_ASSIGN_OR_RETURN(const int64_t lag, ReadLag(open, bundle.sample_period_s, *ekf));
  return std::unique_ptr<Session>(new Session(std::move(model), filter::ReplayFilter(*std::move(ekf), lag), open));
}

Session::Session(std::shared_ptr<const ServedModel> model, filter::ReplayFilter filter, const OpenSession& open)
    : model_(std::move(model)),
      filter_(std::move(filter)),
      estimate_(filter_.ekf().MakeEstimate()),
      format_{.covariance = open.covariance_format() == OpenSession::COVARIANCE_FORMAT_UNSPECIFIED
                                ? OpenSession::NONE
                                : open.covariance_format(),
              .innovations = open.send_innovations(),
              .constrained = filter_.ekf().constrained()},
      row_bytes_(RowBytes(format_, filter_.ekf().estimate_size(), filter_.ekf().output_size())),
      period_s_(model_->bundle.sample_period_s),
      nothing_(VectorXd::Constant(filter_.ekf().output_size(), std::numeric_limits<double>::quiet_NaN())) {}

void Session::Describe(v1::SessionOpened* opened) const {
  const nssm::Bundle& bundle = model_->bundle;
  opened->set_model_version(model_->model_version);
  opened->set_adaptation(model_->adaptation);
  opened->set_input_size(static_cast<uint32_t>(filter_.ekf().input_size()));
  opened->set_output_size(static_cast<uint32_t>(filter_.ekf().output_size()));
  opened->set_estimate_size(static_cast<uint32_t>(filter_.ekf().estimate_size()));
  for (const std::string& name : bundle.model.spec().is_case_one() ? bundle.names.outputs : bundle.names.states) {
    opened->add_estimated()->set_name(name);
  }
  opened->set_sample_period_s(period_s_);
  opened->set_covariance_format(format_.covariance);
  opened->set_send_innovations(format_.innovations);
  opened->set_constrained(format_.constrained);
}

absl::Status Session::Check(const v1::SampleBatch& batch, int64_t rows) const {
  const int64_t n_u = filter_.ekf().input_size(), n_y = filter_.ekf().output_size();
  if (batch.outputs_size() % n_y != 0) {
    return FieldViolation("samples.outputs", absl::StrCat(batch.outputs_size(), " values are no whole rows of ", n_y));
  }
  if (batch.inputs_size() != rows * n_u) {
    return FieldViolation("samples.inputs", absl::StrCat("expected ", rows, " × ", n_u, " values, got ", batch.inputs_size()));
  }
  if (!batch.times_s().empty() && batch.times_s_size() != rows) {
    return FieldViolation("samples.times_s", absl::StrCat("expected ", rows, " values or none, got ", batch.times_s_size()));
  }
  const data::Normaliser& normaliser = model_->bundle.normaliser;
  METAEKF_RETURN_IF_ERROR(CheckValues("samples.inputs", batch.inputs(), normaliser.inputs, false));
  METAEKF_RETURN_IF_ERROR(CheckValues("samples.outputs", batch.outputs(), normaliser.outputs, true));
  if (batch.first_seq() == 0) return FieldViolation("samples.first_seq", "samples are numbered from 1");
  if (batch.first_seq() > seq_ + 1) {
    return WithReason(absl::OutOfRangeError(absl::StrCat("samples.first_seq: expected ", seq_ + 1, ", got ", batch.first_seq())),
                      "SEQUENCE_GAP", {{"expected_seq", absl::StrCat(seq_ + 1)}});
  }
  const int noise = batch.measurement_noise_covs_size();
  for (int64_t row = 0; noise > 0 && row < rows; ++row) {
    METAEKF_ASSIGN_OR_RETURN(const MatrixXd R, NoiseOf(batch, rows, row, n_y));
    const auto factor = filter::SemidefiniteFactor(R);
    if (!factor.ok() || !(factor->diagonal().minCoeff() > 0)) {
      return FieldViolation("samples.measurement_noise_covs",
                            absl::StrCat("row ", row + 1, " of ", rows, " is not positive definite"));
    }
  }
  return CheckTimes(batch);
}

absl::Status Session::CheckTimes(const v1::SampleBatch& batch) const {
  double last = time_s_;
  int64_t remembered = filter_.remembered();
  for (int row = 0; row < batch.times_s_size(); ++row) {
    const double time = batch.times_s(row);
    const std::string field = absl::StrCat("samples.times_s[", row, "]");
    if (!std::isfinite(time)) {
      return FieldViolation(field, absl::StrCat("must be finite, got ", base::FormatExact(time)));
    }
    const uint64_t number = batch.first_seq() + static_cast<uint64_t>(row);
    if (number <= seq_) continue;
    int64_t periods = 1;
    if (number > 1) {
      const auto to_time = PeriodsTo(time, last, remembered);
      if (!to_time.ok()) return FieldViolation(field, std::string(to_time.status().message()));
      periods = *to_time;
    }
    if (periods < 1) continue;
    last = time;
    if (filter_.lag() > 0) remembered = std::min(remembered + periods, filter_.lag() + 1);
  }
  return absl::OkStatus();
}

absl::StatusOr<int64_t> Session::PeriodsTo(double time_s, double last_time_s, int64_t remembered) const {
  const double periods = (time_s - last_time_s) / period_s_;
  const double whole = std::round(periods);
  if (whole < 1 && !(whole > -static_cast<double>(remembered))) {
    const std::string limit = filter_.lag() == 0 ? "time runs backwards"
                              : -whole > static_cast<double>(filter_.lag())
                                  ? absl::StrCat("a measurement may be at most ", filter_.lag(), " sample periods late")
                                  : "a measurement cannot be earlier than the first sample";
    return absl::InvalidArgumentError(absl::StrCat(limit, ": ", base::FormatExact(time_s), " s after ",
                                                   base::FormatExact(last_time_s), " s"));
  }
  if (std::fabs(periods - whole) > kTimeTolerance || whole > static_cast<double>(kMaxMissedPeriods)) {
    return absl::InvalidArgumentError(absl::StrCat(base::FormatExact(time_s), " s is not a whole number of periods of ",
                                                   base::FormatExact(period_s_), " s after ", base::FormatExact(last_time_s), " s"));
  }
  return static_cast<int64_t>(whole);
}

absl::Status Session::Apply(const v1::SampleBatch& batch, bool goes_on, filter::FilterModel::Scratch* scratch,
                            EstimateBatch* estimates) {
  Application application;
  METAEKF_RETURN_IF_ERROR(Begin(batch, goes_on, estimates, &application));
  while (true) {
    filter::NextReplaySample step;
    METAEKF_ASSIGN_OR_RETURN(const bool more, Next(&application, scratch, &step));
    if (!more) return absl::OkStatus();
    StepTogether({&step, 1}, scratch);
    METAEKF_RETURN_IF_ERROR(Taught(step, &application));
  }
}

absl::Status Session::Begin(const v1::SampleBatch& batch, bool goes_on, EstimateBatch* estimates, Application* application) const {
  if (!goes_on) METAEKF_RETURN_IF_ERROR(Check(batch, batch.outputs_size() / filter_.ekf().output_size()));
  *application = {.batch = &batch, .estimates = estimates};
  if (batch.first_seq() <= seq_) application->row = static_cast<int64_t>(seq_ + 1 - batch.first_seq());
  const int64_t n_y = filter_.ekf().output_size(), rows = batch.outputs_size() / n_y - application->row;
  if (rows > 1) Reserve(format_, filter_.ekf().estimate_size(), n_y, std::min(rows, kAnswerBytes / row_bytes_), estimates);
  return absl::OkStatus();
}

absl::StatusOr<bool> Session::Next(Application* application, filter::FilterModel::Scratch* scratch, filter::NextReplaySample* next) {
  const v1::SampleBatch& batch = *application->batch;
  const int64_t n_u = filter_.ekf().input_size(), n_y = filter_.ekf().output_size(), rows = batch.outputs_size() / n_y;
  for (; application->row < rows; ++application->row) {
    const Eigen::Map<const VectorXd> u(batch.inputs().data() + application->row * n_u, n_u), y(batch.outputs().data() + application->row * n_y, n_y);
    if (!application->dated) {
      if ((application->estimates->nis_size() + 1) * row_bytes_ > kAnswerBytes && !application->estimates->nis().empty()) return false;
      METAEKF_ASSIGN_OR_RETURN(const int64_t periods, Date(application));
      if (periods < 1) {
        const MatrixXd* const R = application->measurement_cov ? &*application->measurement_cov : nullptr;
        METAEKF_RETURN_IF_ERROR(filter_.StepDelayed(-periods, y, scratch, &estimate_, R));
        Write(EstimateBatch::DELAYED, application);
        continue;
      }
      application->missed = periods - 1;
      application->dated = true;
    }
    if (application->missed > 0) {
      // A period without a sample: time passes, under the input that was last known.
      application->last_input = filter_.ekf().LastInput();
      *next = {&filter_, application->last_input.data(), nothing_.data(), nullptr, &estimate_, absl::OkStatus()};
    } else {
      const MatrixXd* const R = application->measurement_cov ? &*application->measurement_cov : nullptr;
      *next = {&filter_, u.data(), y.data(), R, &estimate_, absl::OkStatus()};
    }
    return true;
  }
  return false;
}
absl::Status Session::Taught(const filter::NextReplaySample& step, Application* application) {
  METAEKF_RETURN_IF_ERROR(step.status);
  if (application->missed > 0) {
    --application->missed;
    return absl::OkStatus();
  }
  time_s_ = application->time_s;
  Write(EstimateBatch::NO_FLAG, application);
  ++application->row;
  application->dated = false;
  return absl::OkStatus();
}

absl::StatusOr<int64_t> Session::Date(Application* application) const {
  const v1::SampleBatch& batch = *application->batch;
  const int64_t n_y = filter_.ekf().output_size();
  application->measurement_cov.reset();
  if (!batch.measurement_noise_covs().empty()) {
    METAEKF_ASSIGN_OR_RETURN(application->measurement_cov, NoiseOf(batch, batch.outputs_size() / n_y, application->row, n_y));
  }
  application->time_s = seq_ == 0 ? 0 : time_s_ + period_s_;
  if (batch.times_s().empty()) return 1;
  application->time_s = batch.times_s(static_cast<int>(application->row));
  if (seq_ == 0) return 1;
  return PeriodsTo(application->time_s, time_s_, filter_.remembered());
}

void Session::Write(uint32_t flags, Application* application) {
  const int64_t n_y = filter_.ekf().output_size();
  const double* const output = application->batch->outputs().data() + application->row * n_y;
  ++seq_;
  if (application->estimates->times_s().empty()) application->estimates->set_first_seq(seq_);
  if (std::any_of(output, output + n_y, [](double y) { return std::isnan(y); })) flags |= EstimateBatch::MISSING;
  WriteEstimate(format_, application->time_s, estimate_, flags, application->estimates);
}

absl::Status Session::Forecast(const v1::ForecastRequest& request, filter::FilterModel::Scratch* scratch,
                               EstimateBatch* forecast) const {
  const int64_t n_u = filter_.ekf().input_size(), horizon = request.horizon();
  if (horizon < 1 || horizon > kMaxHorizon) {
    return FieldViolation("forecast.horizon", absl::StrCat("must be from 1 to ", kMaxHorizon, ", got ", horizon));
  }
  if (horizon * row_bytes_ > kForecastBytes) {
    return FieldViolation("forecast.horizon", absl::StrCat("estimates of this session take ", row_bytes_, " bytes each; at most ",
                                                           kForecastBytes / row_bytes_, " can be asked for at a time, got ", horizon));
  }
  if (request.inputs_size() != 0 && request.inputs_size() != horizon * n_u) {
    return FieldViolation("forecast.inputs", absl::StrCat("expected ", horizon, " × ", n_u, " values or none, got ", request.inputs_size()));
  }
  MatrixXd inputs = filter_.ekf().LastInput().replicate(1, horizon);
  if (request.inputs_size() != 0) inputs = Eigen::Map<const MatrixXd>(request.inputs().data(), n_u, horizon);
  const auto estimates = filter_.ekf().Forecast(inputs, scratch);
  if (!estimates.ok()) return FieldViolation("forecast.inputs", std::string(estimates.status().message()));
  forecast->set_first_seq(seq_ + 1);
  for (size_t k = 0; k < estimates->size(); ++k) {
    WriteEstimate(format_, time_s_ + static_cast<double>(k + 1) * period_s_, (*estimates)[k], EstimateBatch::MISSING, forecast);
  }
  return absl::OkStatus();
}

std::string Session::Checkpoint() const {
  return Encode({.seq = seq_, .time_s = time_s_, .state = filter_.oldest_state(), .samples = filter_.Samples()});
}

absl::Status Session::Restore(const std::string& bytes, filter::FilterModel::Scratch* scratch) {
  METAEKF_ASSIGN_OR_RETURN(server::Checkpoint checkpoint,
                           DecodeCheckpoint(bytes, filter_.ekf().state(), filter_.ekf().output_size()));
  METAEKF_RETURN_IF_ERROR(filter_.Restore(std::move(checkpoint.state), checkpoint.samples, scratch));
  seq_ = checkpoint.seq;
  time_s_ = checkpoint.time_s;
  return absl::OkStatus();
}

}  // namespace metaekf::server
