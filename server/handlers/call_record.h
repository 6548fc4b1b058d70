#pragma once

#include <grpcpp/server_context.h>
#include <grpcpp/support/status.h>

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <memory>
#include <mutex>
#include <string>

#include "absl/status/status.h"
#include "absl/time/time.h"
#include "server/access/access_control.h"
#include "server/metrics/metrics.h"

namespace metaekf::server {

/// A method of the wire, as it is logged, and what a caller must be allowed to.
struct Rpc {
  const char* name;
  store::Scope scope;
};

/// Calls that have begun and are not done. Safe to call concurrently; outlives them.
class LiveCalls {
 public:
  void Add();
  void Remove();
  /// Returns once there is none, or at the deadline.
  void WaitForNone(absl::Time deadline);

 private:
  std::mutex mutex_;
  std::condition_variable changed_;
  int64_t count_ = 0;
};

/// One call, for the log and the counters: what ends a call ends its record. Safe to call concurrently.
class CallRecord {
 public:
  /// @param call  whose metadata x-request-id names the request, if a client has sent one of at most 64 letters, digits
  /// and -_.; else it gets a name here. It is sent back at the end in any case. The call is live as long as its record.
  CallRecord(const Rpc& rpc, grpc::CallbackServerContext& call, std::shared_ptr<Metrics> metrics, LiveCalls& live);
  ~CallRecord();

  void SetCaller(const Caller& caller);

  /// What the client receives (see ToGrpcStatus). Logged and counted the first time.
  grpc::Status End(const absl::Status& status);

  const std::string& request_id() const { return request_id_; }

 private:
  void Log(const absl::Status& status, absl::Duration duration) const;

  const Rpc rpc_;
  const std::shared_ptr<Metrics> metrics_;
  LiveCalls& live_;
  const absl::Time start_;
  const std::string request_id_;
  std::string tenant_, identity_;
  std::atomic<bool> ended_ = false;
};

}  // namespace metaekf::server
