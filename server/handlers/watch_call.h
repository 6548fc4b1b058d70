#pragma once

#include <grpcpp/support/server_callback.h>

#include <cstdint>
#include <mutex>
#include <optional>
#include <string>

#include "metaekf/v1/training.pb.h"
#include "server/handlers/call_context.h"
#include "server/handlers/call_record.h"

namespace metaekf::server {

/// A WatchJob call: tells the job as it stands, then again whenever it has changed. Changes while
/// the client reads are told together. Owns itself until the call is done.
class WatchCall final : public grpc::ServerWriteReactor<v1::WatchJobResponse> {
 public:
  WatchCall(CallContext context, std::shared_ptr<CallRecord> record, const std::string& name);

  void OnWriteDone(bool ok) override;
  void OnCancel() override;
  void OnDone() override;

 private:
  enum class State { kIdle, kBusy, kFinished };

  void OnEvent(JobFeed::Event event);
  /// Looks at the job on the executor, unless that or a write is under way. Called with the lock
  /// under which the reason arose: once it is free, another thread may finish the call and delete
  /// this.
  void Advance(std::unique_lock<std::mutex> lock);
  void Look();
  void FinishWith(const absl::Status& status);

  CallContext context_;
  const std::shared_ptr<CallRecord> record_;
  int64_t job_ = 0;
  std::optional<int64_t> subscription_;

  std::mutex mutex_;
  v1::WatchJobResponse response_;  // being written while busy
  std::string last_told_;
  bool ended_ = false;  // the job has, and the client was told
  State state_ = State::kBusy;
  bool changed_ = true;
  std::optional<absl::Status> stop_;  // why to end as soon as nothing is under way
};

}  // namespace metaekf::server
