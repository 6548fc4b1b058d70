#include "server/session/estimate_stream.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "server/handlers/overload.h"
#include "server/names/resource_names.h"
#include "server/status/details.h"

namespace metaekf::server {

using std::chrono::steady_clock;

namespace {

constexpr std::chrono::seconds kSlowReader(10);      // a response that waits longer ends the stream
// Longer batches go to threads of their own, and so do those of more rows than a few while many come. To wake a thread costs as much as
// 64 samples of a small model.
constexpr std::chrono::microseconds kLongReaction(200);
constexpr int64_t kFewRows = 8;

// Messages up to here are a part of what a session takes; larger ones are counted, and their memory is not kept for the next.
constexpr int64_t kSmallBytes = 8 << 10;
constexpr int64_t kLargeBytes = 64 << 10;                // requests that are refused where too much is held
constexpr std::chrono::milliseconds kShedPatience(100);  // what has waited less may be under way

int64_t BytesOf(const v1::EstimateRequest& request) {
  if (request.has_forecast()) return 8 * request.forecast().inputs_size();
  const v1::SampleBatch& samples = request.samples();
  return 8 * (int64_t{samples.inputs_size()} + samples.outputs_size() + samples.times_s_size() + samples.measurement_noise_covs_size());
}

absl::Status TooMuchHeld(const char* advice) {
  return WithRetryDelay(absl::ResourceExhaustedError(absl::StrCat("streams hold more batches than the server has memory for; ", advice)),
                        absl::Seconds(1));
}

absl::Status Draining(uint64_t durable_seq) {
  return WithReason(
      absl::UnavailableError(absl::StrCat("the server stops; resume after sample ", durable_seq, " when it is back")),
      "DRAINING", {{"durable_seq", absl::StrCat(durable_seq)}});
}

}  // namespace

EstimateStream::EstimateStream(EstimationService* service, grpc::CallbackServerContext* context, std::shared_ptr<CallRecord> record, Caller caller)
    : service_(*service),
      context_(context),
      record_(std::move(record)),
      caller_(std::move(caller)),
      rate_(service->rates_.Of(caller_.tenant)),
      counters_(service->server_.metrics->OfStreams(caller_.tenant)) {}

void EstimateStream::Start(bool draining) {
  std::lock_guard lock(mutex_);
  if (draining) finish_with_ = Draining(0);
  Advance();
}

void EstimateStream::OnReadDone(bool ok) {
  std::lock_guard lock(mutex_);
  read_time_ = steady_clock::now();
  reading_ = false;
  (ok ? has_request_ : half_closed_) = true;
  if (ok && BytesOf(request_) > kLargeBytes && service_.HoldsTooMuch()) {
    has_request_ = false;
    request_ = v1::EstimateRequest();
    EndForMemory("send smaller ones, or again in a second");
  }
  Advance();
}

void EstimateStream::OnWriteDone(bool ok) {
  std::lock_guard lock(mutex_);
  writing_ = false;
  if (answer_bytes_ > kSmallBytes) response_ = v1::EstimateResponse();
  if (!goes_on_ && BytesOf(work_) > kSmallBytes) work_ = v1::EstimateRequest();  // which the next is read into
  if (!ok) End(absl::CancelledError("the client has gone"));
  Advance();
}

void EstimateStream::OnCancel() {
  std::lock_guard lock(mutex_);
  End(absl::CancelledError("the call was cancelled"));
  Advance();
}

void EstimateStream::OnDone() {
  // Whoever called Finish may still hold the mutex on another thread: it must have let go before this is deleted.
  { std::lock_guard lock(mutex_); }
  // A lost connection looks like the end of the requests first.
  const bool all_arrived = finish_with_ && finish_with_->ok() && !context_->IsCancelled();
  if (live_ != nullptr) service_.sessions_.Close(live_, all_arrived);
  service_.CountHeld(-counted_bytes_);
  service_.Remove(this);
  delete this;
}

void EstimateStream::StopApplying() {
  std::lock_guard lock(mutex_);
  stop_applying_ = true;
}

void EstimateStream::EndForDrain() {
  std::lock_guard lock(mutex_);
  uint64_t durable = 0;
  if (live_ != nullptr) {
    std::lock_guard session_lock(live_->mutex);
    durable = live_->durable_seq;
  }
  End(Draining(durable));
  Advance();
}

void EstimateStream::Sweep(steady_clock::time_point now) {
  std::lock_guard lock(mutex_);
  if (writing_ && now - write_start_ > kSlowReader) {
    End(absl::ResourceExhaustedError("responses were not read for ten seconds"));
    context_->TryCancel();  // an outstanding write ends only so
  }
  if (live_ != nullptr && !working_) {
    std::lock_guard session_lock(live_->mutex);
    if (live_->taken_over) End(TakenOver());
  }
  Advance();
}

std::optional<std::pair<steady_clock::time_point, int64_t>> EstimateStream::Waits(steady_clock::time_point now) {
  std::lock_guard lock(mutex_);
  const steady_clock::time_point since = writing_ ? write_start_ : read_time_;
  if (working_ || finish_with_ || counted_bytes_ == 0 || now - since < kShedPatience) return std::nullopt;
  return std::pair(since, counted_bytes_);
}

void EstimateStream::Shed() {
  std::lock_guard lock(mutex_);
  EndForMemory("read faster, or send smaller ones");
  Advance();
}

void EstimateStream::End(absl::Status status) {
  if (!finish_with_) finish_with_ = std::move(status);
}

void EstimateStream::EndForMemory(const char* advice) {
  End(TooMuchHeld(advice));
  if (writing_) context_->TryCancel();  // an outstanding write ends only so
}

void EstimateStream::Advance() {
  StartNext();
  Account();
}

void EstimateStream::StartNext() {
  if (finished_ || working_) return;
  if (finish_with_) {
    if (writing_) return;
    finished_ = true;
    Finish(record_->End(*finish_with_));
    return;
  }
  if ((goes_on_ || has_request_) && !writing_ && !stop_applying_ && MayWork()) {
    if (!goes_on_) {
      has_request_ = false;
      request_.Swap(&work_);
      work_time_ = read_time_;
    }
    working_ = true;
    StartWork();
    return;
  }
  if (half_closed_ && !has_request_ && !goes_on_) {
    End(live_ == nullptr ? absl::InvalidArgumentError("the first request must open or resume a session")
                         : absl::OkStatus());
    return StartNext();
  }
  Read();
}

bool EstimateStream::MayWork() const {
  if (rate_ != nullptr && !rate_->IsReady(steady_clock::now())) return false;
  if (live_ == nullptr || !service_.HoldsTooMuch()) return true;
  return ValuesOf(goes_on_ ? work_ : request_) / output_size_ * row_bytes_ <= kSmallBytes;
}

void EstimateStream::StartWork() {
  if (live_ != nullptr && IsShort() && (!Queues() || live_->queue->Enter())) {
    // Applied in this reaction, but without the mutex, which the caller holds. Reading on waits for the response
    // to be on its way, which a single sensor's latency is made of.
    mutex_.unlock();
    const absl::Status status = Apply();
    if (Queues() && live_->queue->Leave()) service_.WorkThrough(live_->queue);
    mutex_.lock();
    return WorkDone(status);
  }
  Read();
  if (live_ != nullptr && Queues()) {
    response_.Clear();
    if (live_->queue->Add({live_, &work_.samples(), goes_on_, response_.mutable_estimates(), [this](const absl::Status& status, auto cost) { Applied(status, cost); }})) {
      service_.WorkThrough(live_->queue);
    }
    return;
  }
  const bool accepted = live_ == nullptr ? service_.server_.io.Submit([this] { Work([this] { return OpenOrResume(); }); })
                                         : service_.heavy_.Submit([this] { Work([this] { return Apply(); }); });
  if (!accepted) WorkDone(Overloaded());
}

bool EstimateStream::IsShort() {
  const int64_t values = ValuesOf(work_);
  return values * time_per_value_ <= kLongReaction && (values <= kFewRows * output_size_ || !service_.crowd_.Joins(steady_clock::now(), &rush_));
}

bool EstimateStream::Queues() const { return work_.has_samples() && live_->queue->model()->is_large(); }

void EstimateStream::Applied(const absl::Status& status, steady_clock::duration cost) {
  if (response_.estimates().nis_size() > 0) {
    service_.sessions_.MarkDirty(live_);
    TookPerValue(cost / (int64_t{response_.estimates().nis_size()} * output_size_));
  }
  std::lock_guard lock(mutex_);
  WorkDone(status);
}

void EstimateStream::Read() {
  if (reading_ || has_request_ || half_closed_) return;
  reading_ = true;
  StartRead(&request_);
}

template <typename Function>
void EstimateStream::Work(const Function& function) {
  const absl::Status status = function();
  std::lock_guard lock(mutex_);
  WorkDone(status);
}

void EstimateStream::WorkDone(const absl::Status& status) {
  working_ = false;
  goes_on_ = status.ok() && HasRest();
  answer_bytes_ = row_bytes_ * (int64_t{response_.estimates().nis_size()} + response_.forecast().nis_size());
  if (status.ok() && response_.estimates().nis_size() > 0) Count(response_.estimates());
  if (!status.ok()) {
    End(status);
  } else if (response_.kind_case() != v1::EstimateResponse::KIND_NOT_SET && !finish_with_) {
    writing_ = true;
    write_start_ = steady_clock::now();
    StartWrite(&response_);
  }
  Advance();
}

bool EstimateStream::HasRest() const {
  const v1::EstimateBatch& estimates = response_.estimates();
  if (!work_.has_samples() || estimates.nis().empty()) return false;
  const auto rows = static_cast<uint64_t>(work_.samples().outputs_size() / output_size_);
  return estimates.first_seq() + static_cast<uint64_t>(estimates.nis_size()) < work_.samples().first_seq() + rows;
}

void EstimateStream::Account() {
  int64_t bytes = has_request_ ? BytesOf(request_) : 0;
  if (working_ || goes_on_) bytes += BytesOf(work_);
  if (writing_) bytes += 2 * answer_bytes_;  // as a message, and as gRPC holds it
  if (bytes <= kSmallBytes) bytes = 0;
  if (bytes == counted_bytes_) return;
  service_.CountHeld(bytes - counted_bytes_);
  counted_bytes_ = bytes;
}

void EstimateStream::Count(const v1::EstimateBatch& estimates) {
  const steady_clock::time_point now = steady_clock::now();
  int64_t gated = 0, resets = 0;
  for (const uint32_t flags : estimates.flags()) {
    gated += (flags & v1::EstimateBatch::GATED) != 0;
    resets += (flags & v1::EstimateBatch::RESET) != 0;
  }
  const absl::Span<const double> nis(estimates.nis().data(), static_cast<size_t>(estimates.nis_size()));
  service_.server_.metrics->CountBatch(counters_, nis, gated, resets, absl::FromChrono(now - work_time_));
  if (rate_ != nullptr) rate_->Count(estimates.nis_size(), now);
}

absl::Status EstimateStream::OpenOrResume() {
  absl::StatusOr<std::shared_ptr<LiveSession>> live;
  store::TenantStore mine = service_.server_.store.Of(caller_.tenant, caller_.identity);
  switch (work_.kind_case()) {
    case v1::EstimateRequest::kOpen:
      live = service_.sessions_.Open(mine, work_.open());
      break;
    case v1::EstimateRequest::kResume:
      live = service_.sessions_.Resume(mine, work_.resume());
      break;
    default:
      return FieldViolation("kind", "the first request must open or resume a session");
  }
  if (!live.ok()) return live.status();
  v1::SessionOpened* opened = response_.mutable_opened();
  {
    std::lock_guard session_lock((*live)->mutex);
    (*live)->session->Describe(opened);
    opened->set_session(SessionName((*live)->number));
    opened->set_token((*live)->token);
    opened->set_epoch((*live)->epoch);
    opened->set_durable_seq((*live)->durable_seq);
    output_size_ = opened->output_size();
    row_bytes_ = (*live)->session->row_bytes();
    // A batch of the largest models takes about 20 ns per parameter and output; measured from then on.
    time_per_value_ = last_time_per_value_ = std::chrono::nanoseconds(
        static_cast<int64_t>((*live)->session->model().bundle.parameters.size()));
  }
  std::lock_guard lock(mutex_);
  live_ = *std::move(live);
  return absl::OkStatus();
}

int64_t EstimateStream::ValuesOf(const v1::EstimateRequest& work) const {
  return work.has_forecast() ? int64_t{work.forecast().horizon()} * output_size_ : work.samples().outputs_size();
}

absl::Status EstimateStream::Apply() {
  if (!work_.has_samples() && !work_.has_forecast()) {
    return FieldViolation("kind", "the session is open: send samples or ask for a forecast");
  }
  response_.Clear();
  const steady_clock::time_point start = steady_clock::now();
  std::unique_ptr<filter::FilterModel::Scratch> scratch = live_->queue->Take();
  absl::Status status;
  bool applied = false;
  {
    std::lock_guard session_lock(live_->mutex);
    if (live_->taken_over) {
      status = TakenOver();
    } else if (work_.has_forecast()) {
      v1::EstimateBatch* forecast = response_.mutable_forecast();
      status = live_->session->Forecast(work_.forecast(), scratch.get(), forecast);
      forecast->set_durable_seq(live_->durable_seq);
    } else {
      v1::EstimateBatch* estimates = response_.mutable_estimates();
      status = live_->session->Apply(work_.samples(), goes_on_, scratch.get(), estimates);
      CompleteAnswer(work_.samples(), *live_, estimates);
      applied = estimates->nis_size() > 0;
    }
  }
  live_->queue->GiveBack(std::move(scratch));
  if (applied) service_.sessions_.MarkDirty(live_);
  const int64_t values = output_size_ * (int64_t{response_.estimates().nis_size()} + response_.forecast().nis_size());
  if (values > 0) TookPerValue((steady_clock::now() - start) / values);
  return status;
}

void EstimateStream::TookPerValue(steady_clock::duration time) {
  // The less of two: who was interrupted is not slow, and a batch that is taken for long has to wait for long ones.
  time_per_value_ = std::min(time, last_time_per_value_);
  last_time_per_value_ = time;
}

}  // namespace metaekf::server
