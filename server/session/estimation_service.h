#pragma once

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <memory>
#include <mutex>
#include <set>
#include <thread>

#include "metaekf/v1/estimation.grpc.pb.h"
#include "server/executor/background_executor.h"
#include "server/handlers/service_context.h"
#include "server/session/crowd.h"
#include "server/session/sample_rate.h"
#include "server/session/session_manager.h"

namespace metaekf::server {

class EstimateStream;
struct Rpc;

/// The EstimationService of the wire over a SessionManager.
class EstimationService : public v1::EstimationService::CallbackService {
 public:
  /// All arguments outlive the service.
  EstimationService(const ServiceContext& server, SessionManager& sessions);
  ~EstimationService() override;

  /// Ends every stream with UNAVAILABLE (DRAINING, durable_seq) once its last response is out, and refuses new ones.
  /// Returns when all are gone, or at the deadline: what is left then is cancelled.
  void Drain(std::chrono::steady_clock::time_point deadline);

  grpc::ServerBidiReactor<v1::EstimateRequest, v1::EstimateResponse>* Estimate(
      grpc::CallbackServerContext* context) override;
  grpc::ServerUnaryReactor* GetSession(grpc::CallbackServerContext* context, const v1::GetSessionRequest* request,
                                       v1::Session* response) override;
  grpc::ServerUnaryReactor* ListSessions(grpc::CallbackServerContext* context, const v1::ListSessionsRequest* request,
                                         v1::ListSessionsResponse* response) override;
  grpc::ServerUnaryReactor* DeleteSession(grpc::CallbackServerContext* context, const v1::DeleteSessionRequest* request,
                                          google::protobuf::Empty* response) override;

 private:
  friend class EstimateStream;
  /// Answers with what `work` makes of the caller's part of the store.
  template <class Work>
  grpc::ServerUnaryReactor* Answer(grpc::CallbackServerContext* context, const Rpc& rpc, const Work& work);
  void Remove(EstimateStream* stream);
  /// Has batches that wait applied.
  void WorkThrough(const std::shared_ptr<BatchQueue>& queue);
  void RunSweeps();

  /// A stream holds so much more, or less, of batches and answers than before.
  void CountHeld(int64_t change);
  bool HoldsTooMuch() const;
  /// Ends the streams that have waited longest, until the rest holds no more than it may. With mutex_ held.
  void Shed(std::chrono::steady_clock::time_point now);

  const ServiceContext& server_;
  SessionManager& sessions_;
  SampleRates rates_;
  std::atomic<int64_t> held_bytes_ = 0;
  Crowd crowd_;  // of batches that a reaction may do
  BackgroundExecutor heavy_;  // batches that a reaction may not do; each stream has one at most

  std::mutex mutex_;
  std::condition_variable changed_;
  std::set<EstimateStream*> streams_;
  bool draining_ = false;
  bool stopping_ = false;
  std::thread sweeps_;
};

}  // namespace metaekf::server
