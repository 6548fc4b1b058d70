#include "server/session/estimation_service.h"

#include <algorithm>
#include <limits>
#include <optional>
#include <tuple>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "server/executor/give_way.h"
#include "server/handlers/overload.h"
#include "server/handlers/unary_call.h"
#include "server/metrics/metrics.h"
#include "server/names/resource_names.h"
#include "server/status/details.h"

namespace metaekf::server {

using std::chrono::steady_clock;

namespace {

constexpr std::chrono::seconds kSlowReader(10);      // a response that waits longer ends the stream
constexpr std::chrono::milliseconds kSweepPeriod(500);
// Longer batches go to threads of their own. To wake one costs as much as 64 samples of a small model.
constexpr std::chrono::microseconds kLongReaction(200);

// Messages up to here are a part of what a session takes; larger ones are counted, and their memory is not kept for the next.
constexpr int64_t kSmallBytes = 8 << 10;
constexpr int64_t kLargeBytes = 64 << 10;                // requests that are refused where too much is held
constexpr std::chrono::milliseconds kShedPatience(100);  // what has waited less may be under way
constexpr std::chrono::milliseconds kShedPeriod(20);

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

/// One stream: open or resume, then batch by batch. At any time at most one read and one write are in flight and one
/// batch is in work; the next batch, or the rest of a large one, waits for the response before it. `mutex_` guards everything;
/// the batch itself is applied without it.
class EstimateStream : public grpc::ServerBidiReactor<v1::EstimateRequest, v1::EstimateResponse> {
 public:
  EstimateStream(EstimationService* service, grpc::CallbackServerContext* context, std::shared_ptr<CallRecord> record,
                 Caller caller)
      : service_(*service),
        context_(context),
        record_(std::move(record)),
        caller_(std::move(caller)),
        rate_(service->rates_.Of(caller_.tenant)),
        counters_(service->server_.metrics->OfStreams(caller_.tenant)) {}

  void Start(bool draining) {
    std::lock_guard lock(mutex_);
    if (draining) finish_with_ = Draining(0);
    Advance();
  }

  void OnReadDone(bool ok) override {
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

  void OnWriteDone(bool ok) override {
    std::lock_guard lock(mutex_);
    writing_ = false;
    if (answer_bytes_ > kSmallBytes) response_ = v1::EstimateResponse();
    if (!goes_on_ && BytesOf(work_) > kSmallBytes) work_ = v1::EstimateRequest();  // which the next is read into
    if (!ok) End(absl::CancelledError("the client has gone"));
    Advance();
  }

  void OnCancel() override {
    std::lock_guard lock(mutex_);
    End(absl::CancelledError("the call was cancelled"));
    Advance();
  }

  void OnDone() override {
    // Whoever called Finish may still hold the mutex on another thread: it must have let go before this is deleted.
    { std::lock_guard lock(mutex_); }
    // A lost connection looks like the end of the requests first.
    const bool all_arrived = finish_with_ && finish_with_->ok() && !context_->IsCancelled();
    if (live_ != nullptr) service_.sessions_.Close(live_, all_arrived);
    service_.CountHeld(-counted_bytes_);
    service_.Remove(this);
    delete this;
  }

  /// First half of a drain: applies nothing more.
  void StopApplying() {
    std::lock_guard lock(mutex_);
    stop_applying_ = true;
  }

  /// Second half: all that was applied is durable.
  void EndForDrain() {
    std::lock_guard lock(mutex_);
    uint64_t durable = 0;
    if (live_ != nullptr) {
      std::lock_guard session_lock(live_->mutex);
      durable = live_->durable_seq;
    }
    End(Draining(durable));
    Advance();
  }

  /// Ends a stream whose client does not read or whose session is no longer its own.
  void Sweep(steady_clock::time_point now) {
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

  void Cancel() { context_->TryCancel(); }

  /// What the stream holds while it waits for its client, and since when; nothing if it is at work or has not waited long.
  std::optional<std::pair<steady_clock::time_point, int64_t>> Waits(steady_clock::time_point now) {
    std::lock_guard lock(mutex_);
    const steady_clock::time_point since = writing_ ? write_start_ : read_time_;
    if (working_ || finish_with_ || counted_bytes_ == 0 || now - since < kShedPatience) return std::nullopt;
    return std::pair(since, counted_bytes_);
  }

  void Shed() {
    std::lock_guard lock(mutex_);
    EndForMemory("read faster, or send smaller ones");
    Advance();
  }

 private:
  void End(absl::Status status) {
    if (!finish_with_) finish_with_ = std::move(status);
  }

  void EndForMemory(const char* advice) {
    End(TooMuchHeld(advice));
    if (writing_) context_->TryCancel();  // an outstanding write ends only so
  }

  /// Starts whatever may start now. With mutex_ held; every event ends here.
  void Advance() {
    StartNext();
    Account();
  }

  void StartNext() {
    if (finished_ || working_) return;
    if (finish_with_) {
      if (writing_) return;
      finished_ = true;
      Finish(record_->End(*finish_with_));
      return;
    }
    // Beyond its tenant's rate a request waits, and with it the client; the next sweep looks again.
    const bool may_work = rate_ == nullptr || rate_->IsReady(steady_clock::now());
    if ((goes_on_ || has_request_) && !writing_ && !stop_applying_ && may_work) {
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

  /// With mutex_ held and working_ set.
  void StartWork() {
    if (live_ != nullptr && ValuesOf(work_) * time_per_value_ <= kLongReaction && (!queues() || live_->queue->Enter())) {
      // The batch is short: applied in this reaction, but without the mutex, which the caller holds. Reading on waits for the response
      // to be on its way, which a single sensor's latency is made of.
      mutex_.unlock();
      const absl::Status status = Apply();
      if (queues() && live_->queue->Leave()) service_.WorkThrough(live_->queue);
      mutex_.lock();
      return WorkDone(status);
    }
    Read();
    if (live_ != nullptr && queues()) {
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

  /// Whether batches of many sessions of this model are applied together where they wait.
  bool queues() const { return work_.has_samples() && live_->queue->model()->is_large(); }

  void Applied(const absl::Status& status, steady_clock::duration cost) {
    if (response_.estimates().nis_size() > 0) {
      service_.sessions_.MarkDirty(live_);
      time_per_value_ = cost / (int64_t{response_.estimates().nis_size()} * output_size_);
    }
    std::lock_guard lock(mutex_);
    WorkDone(status);
  }

  /// With mutex_ held.
  void Read() {
    if (reading_ || has_request_ || half_closed_) return;
    reading_ = true;
    StartRead(&request_);
  }

  template <typename Function>
  void Work(const Function& function) {
    const absl::Status status = function();
    std::lock_guard lock(mutex_);
    WorkDone(status);
  }

  /// With mutex_ held.
  void WorkDone(const absl::Status& status) {
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

  /// Whether the answer does not reach the batch's end: it holds so much and no more.
  bool HasRest() const {
    const v1::EstimateBatch& estimates = response_.estimates();
    if (!work_.has_samples() || estimates.nis().empty()) return false;
    const auto rows = static_cast<uint64_t>(work_.samples().outputs_size() / output_size_);
    return estimates.first_seq() + static_cast<uint64_t>(estimates.nis_size()) < work_.samples().first_seq() + rows;
  }

  /// Tells the service how much the stream holds. With mutex_ held.
  void Account() {
    int64_t bytes = has_request_ ? BytesOf(request_) : 0;
    if (working_ || goes_on_) bytes += BytesOf(work_);
    if (writing_) bytes += 2 * answer_bytes_;  // as a message, and as gRPC holds it
    if (bytes <= kSmallBytes) bytes = 0;
    if (bytes == counted_bytes_) return;
    service_.CountHeld(bytes - counted_bytes_);
    counted_bytes_ = bytes;
  }

  /// With mutex_ held, after each batch.
  void Count(const v1::EstimateBatch& estimates) {
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

  absl::Status OpenOrResume() {
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
      // A batch of the largest models takes about 20 ns per parameter and output; measured from the first batch on.
      time_per_value_ = std::chrono::nanoseconds(
          static_cast<int64_t>((*live)->session->model().bundle.parameters.size()));
    }
    std::lock_guard lock(mutex_);
    live_ = *std::move(live);
    return absl::OkStatus();
  }

  /// Outputs that are estimated, which is what work takes time for.
  int64_t ValuesOf(const v1::EstimateRequest& work) const {
    return work.has_forecast() ? int64_t{work.forecast().horizon()} * output_size_ : work.samples().outputs_size();
  }

  absl::Status Apply() {
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
    if (values > 0) time_per_value_ = (steady_clock::now() - start) / values;
    return status;
  }

  EstimationService& service_;
  grpc::CallbackServerContext* const context_;
  const FreeProcessor free_processor_;
  const std::shared_ptr<CallRecord> record_;
  const Caller caller_;  // and not what its tenant has: streams are many, and need it once
  SampleRate* const rate_;  // of its tenant; null: as fast as it likes
  const StreamCounters counters_;
  v1::EstimateRequest request_;    // being read, or waiting
  v1::EstimateRequest work_;       // being worked on
  v1::EstimateResponse response_;  // being made or written
  std::shared_ptr<LiveSession> live_;
  int64_t output_size_ = 0;
  int64_t row_bytes_ = 0;
  steady_clock::duration time_per_value_{};  // of outputs in a batch, as last measured

  std::mutex mutex_;
  bool reading_ = false;
  bool has_request_ = false;  // request_ holds a request that waits
  bool half_closed_ = false;
  bool working_ = false;
  bool goes_on_ = false;  // work_ has a rest, for the next answer
  bool writing_ = false;
  bool stop_applying_ = false;
  bool finished_ = false;
  std::optional<absl::Status> finish_with_;
  steady_clock::time_point read_time_;   // of request_
  steady_clock::time_point work_time_;   // when work_ was read
  steady_clock::time_point write_start_;
  int64_t answer_bytes_ = 0;   // of response_
  int64_t counted_bytes_ = 0;  // that the service knows of
};

EstimationService::EstimationService(const ServiceContext& server, SessionManager& sessions)
    : server_(server), sessions_(sessions), rates_(server.options.quotas), heavy_({.threads = 2, .max_queued = std::numeric_limits<size_t>::max()}), sweeps_([this] { RunSweeps(); }) {}

EstimationService::~EstimationService() {
  {
    std::lock_guard lock(mutex_);
    stopping_ = true;
  }
  changed_.notify_all();
  sweeps_.join();
}

grpc::ServerBidiReactor<v1::EstimateRequest, v1::EstimateResponse>* EstimationService::Estimate(
    grpc::CallbackServerContext* context) {
  using Reactor = grpc::ServerBidiReactor<v1::EstimateRequest, v1::EstimateResponse>;
  return Admitted<Reactor>(context, server_, {"Estimate", store::Scope::kStream}, [&](CallContext admitted, const auto& record) {
    auto* stream = new EstimateStream(this, context, record, std::move(admitted.caller));
    bool draining;
    {
      std::lock_guard lock(mutex_);
      streams_.insert(stream);
      draining = draining_;
    }
    stream->Start(draining);
    return stream;
  });
}

void EstimationService::WorkThrough(const std::shared_ptr<BatchQueue>& queue) {
  (void)heavy_.Submit([this, queue] {
    if (queue->Work()) WorkThrough(queue);
  });
}

void EstimationService::Remove(EstimateStream* stream) {
  std::lock_guard lock(mutex_);
  streams_.erase(stream);
  changed_.notify_all();
}

// Streams leave the set, with mutex_, before they are deleted: what is found in it while mutex_ is held is alive.
void EstimationService::RunSweeps() {
  std::unique_lock lock(mutex_);
  steady_clock::time_point next_sweep = steady_clock::now() + kSweepPeriod;
  while (!stopping_) {
    changed_.wait_until(lock, std::min(next_sweep, HoldsTooMuch() ? steady_clock::now() + kShedPeriod : next_sweep));
    const steady_clock::time_point now = steady_clock::now();
    if (HoldsTooMuch()) Shed(now);
    if (now < next_sweep) continue;
    for (EstimateStream* stream : streams_) stream->Sweep(now);
    next_sweep = now + kSweepPeriod;
  }
}

void EstimationService::CountHeld(int64_t change) {
  const int64_t before = held_bytes_.fetch_add(change), most = server_.options.limits.batch_bytes;
  if (before <= most && before + change > most) changed_.notify_all();
}

bool EstimationService::HoldsTooMuch() const { return held_bytes_ > server_.options.limits.batch_bytes; }

void EstimationService::Shed(steady_clock::time_point now) {
  std::vector<std::tuple<steady_clock::time_point, int64_t, EstimateStream*>> waiting;
  for (EstimateStream* stream : streams_) {
    if (const auto waits = stream->Waits(now)) waiting.emplace_back(waits->first, waits->second, stream);
  }
  std::sort(waiting.begin(), waiting.end());
  int64_t over = held_bytes_ - server_.options.limits.batch_bytes;
  for (const auto& [since, bytes, stream] : waiting) {
    if (over <= 0) return;
    stream->Shed();
    over -= bytes;
  }
}

void EstimationService::Drain(steady_clock::time_point deadline) {
  {
    std::lock_guard lock(mutex_);
    draining_ = true;
    for (EstimateStream* stream : streams_) stream->StopApplying();
  }
  sessions_.Flush();
  std::unique_lock lock(mutex_);
  for (EstimateStream* stream : streams_) stream->EndForDrain();
  if (changed_.wait_until(lock, deadline, [this] { return streams_.empty(); })) return;
  for (EstimateStream* stream : streams_) stream->Cancel();
  changed_.wait(lock, [this] { return streams_.empty(); });
}

template <class Work>
grpc::ServerUnaryReactor* EstimationService::Answer(grpc::CallbackServerContext* context, const Rpc& rpc, const Work& work) {
  return Admitted<grpc::ServerUnaryReactor>(context, server_, rpc, [&](CallContext caller, const auto& record) {
    return FinishWith(context, record, server_.io, [work, caller = std::move(caller)]() mutable { return work(caller.store); });
  });
}

grpc::ServerUnaryReactor* EstimationService::GetSession(grpc::CallbackServerContext* context,
                                                        const v1::GetSessionRequest* request, v1::Session* response) {
  return Answer(context, {"GetSession", store::Scope::kRead}, [this, request, response](store::TenantStore& mine) -> absl::Status {
    METAEKF_ASSIGN_OR_RETURN(*response, sessions_.Get(mine, request->name()));
    return absl::OkStatus();
  });
}

grpc::ServerUnaryReactor* EstimationService::ListSessions(grpc::CallbackServerContext* context,
                                                          const v1::ListSessionsRequest* request,
                                                          v1::ListSessionsResponse* response) {
  return Answer(context, {"ListSessions", store::Scope::kRead}, [this, request, response](store::TenantStore& mine) -> absl::Status {
    METAEKF_ASSIGN_OR_RETURN(*response, sessions_.List(mine, *request));
    return absl::OkStatus();
  });
}

grpc::ServerUnaryReactor* EstimationService::DeleteSession(grpc::CallbackServerContext* context,
                                                           const v1::DeleteSessionRequest* request,
                                                           google::protobuf::Empty*) {
  return Answer(context, {"DeleteSession", store::Scope::kStream}, [this, request](store::TenantStore& mine) { return sessions_.Delete(mine, request->name()); });
}

}  // namespace metaekf::server
