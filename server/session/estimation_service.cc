#include "server/session/estimation_service.h"

#include <algorithm>
#include <limits>
#include <optional>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
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

constexpr int kManyRows = 128;  // in a batch, whose memory is not kept for the next

absl::Status Draining(uint64_t durable_seq) {
  return WithReason(
      absl::UnavailableError(absl::StrCat("the server stops; resume after sample ", durable_seq, " when it is back")),
      "DRAINING", {{"durable_seq", absl::StrCat(durable_seq)}});
}

}  // namespace

/// One stream: open or resume, then batch by batch. At any time at most one read and one write are in flight and one
/// batch is in work; the next batch waits for the response before it. `mutex_` guards everything; the batch itself is
/// applied without it.
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
    Advance();
  }

  void OnWriteDone(bool ok) override {
    std::lock_guard lock(mutex_);
    writing_ = false;
    if (response_.estimates().nis_size() > kManyRows) ForgetLargeMessages();
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

 private:
  void End(absl::Status status) {
    if (!finish_with_) finish_with_ = std::move(status);
  }

  /// Starts whatever may start now. With mutex_ held; every event ends here.
  void Advance() {
    if (finished_ || working_) return;
    if (finish_with_) {
      if (writing_) return;
      finished_ = true;
      Finish(record_->End(*finish_with_));
      return;
    }
    // Beyond its tenant's rate a request waits, and with it the client; the next sweep looks again.
    const bool may_work = rate_ == nullptr || rate_->IsReady(steady_clock::now());
    if (has_request_ && !writing_ && !stop_applying_ && may_work) {
      has_request_ = false;
      request_.Swap(&work_);
      work_time_ = read_time_;
      working_ = true;
      StartWork();
      return;
    }
    if (half_closed_ && !has_request_) {
      End(live_ == nullptr ? absl::InvalidArgumentError("the first request must open or resume a session")
                           : absl::OkStatus());
      return Advance();
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
      if (live_->queue->Add({live_, &work_.samples(), response_.mutable_estimates(), [this](const absl::Status& status, auto cost) { Applied(status, cost); }})) {
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
      time_per_value_ = cost / work_.samples().outputs_size();
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

  /// Messages keep the memory that they once had. With mutex_ held, between a batch and the next.
  void ForgetLargeMessages() {
    response_ = v1::EstimateResponse();
    work_ = v1::EstimateRequest();
    if (!reading_ && !has_request_) request_ = v1::EstimateRequest();
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
        status = live_->session->Apply(work_.samples(), scratch.get(), estimates);
        CompleteAnswer(work_.samples(), *live_, estimates);
        applied = estimates->nis_size() > 0;
      }
    }
    live_->queue->GiveBack(std::move(scratch));
    if (applied) service_.sessions_.MarkDirty(live_);
    const int64_t values = ValuesOf(work_);
    if (values > 0) time_per_value_ = (steady_clock::now() - start) / values;
    return status;
  }

  EstimationService& service_;
  grpc::CallbackServerContext* const context_;
  const std::shared_ptr<CallRecord> record_;
  const Caller caller_;  // and not what its tenant has: streams are many, and need it once
  SampleRate* const rate_;  // of its tenant; null: as fast as it likes
  const StreamCounters counters_;
  v1::EstimateRequest request_;    // being read, or waiting
  v1::EstimateRequest work_;       // being worked on
  v1::EstimateResponse response_;  // being made or written
  std::shared_ptr<LiveSession> live_;
  int64_t output_size_ = 0;
  steady_clock::duration time_per_value_{};  // of outputs in a batch, as last measured

  std::mutex mutex_;
  bool reading_ = false;
  bool has_request_ = false;  // request_ holds a request that waits
  bool half_closed_ = false;
  bool working_ = false;
  bool writing_ = false;
  bool stop_applying_ = false;
  bool finished_ = false;
  std::optional<absl::Status> finish_with_;
  steady_clock::time_point read_time_;   // of request_
  steady_clock::time_point work_time_;   // when work_ was read
  steady_clock::time_point write_start_;
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
  while (!changed_.wait_for(lock, kSweepPeriod, [this] { return stopping_; })) {
    const steady_clock::time_point now = steady_clock::now();
    for (EstimateStream* stream : streams_) stream->Sweep(now);
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
