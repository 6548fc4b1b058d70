#include "server/session/estimation_service.h"

#include <algorithm>
#include <limits>
#include <tuple>
#include <utility>
#include <vector>

#include "core/base/status.h"
#include "server/handlers/unary_call.h"
#include "server/session/estimate_stream.h"

namespace metaekf::server {

using std::chrono::steady_clock;

namespace {

constexpr std::chrono::milliseconds kSweepPeriod(500);
constexpr std::chrono::milliseconds kShedPeriod(20);

}  // namespace

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
