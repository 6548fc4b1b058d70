#pragma once

#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

#include <atomic>
#include <deque>
#include <memory>
#include <mutex>
#include <optional>
#include <utility>

#include "server/executor/background_executor.h"
#include "server/handlers/call_record.h"
#include "server/handlers/overload.h"
#include "server/handlers/stream_handler.h"

namespace metaekf::server {

/// Runs a StreamHandler on a bidirectional call. Owns itself until the call is done.
///
/// One thing after the other: read, handle on an executor, write what the handler sent (which may
/// begin while it still runs), read again. So a client that does not read is not read from either.
template <class Request, class Response>
class BidiCall final : public grpc::ServerBidiReactor<Request, Response>,
                       private ResponseSink<Response> {
 public:
  /// @param at_request, at_end  where the handler's two functions run.
  BidiCall(grpc::CallbackServerContext* context, std::shared_ptr<CallRecord> record,
           std::unique_ptr<StreamHandler<Request, Response>> handler,
           BackgroundExecutor& at_request, BackgroundExecutor& at_end)
      : context_(context), record_(std::move(record)), handler_(std::move(handler)), at_request_(at_request), at_end_(at_end) {
    if (at_end.is_full()) {  // what would be refused at its end need not be sent first
      this->Finish(record_->End(Overloaded()));
    } else {
      this->StartRead(&request_);
    }
  }

  void OnReadDone(bool ok) override {
    BackgroundExecutor& executor = ok ? at_request_ : at_end_;
    if (!executor.Submit([this, ok] { Handle(ok); })) EndStep(Overloaded(), true);
  }

  void OnWriteDone(bool ok) override {
    std::unique_lock lock(mutex_);
    writing_ = false;
    outbox_.pop_front();
    if (!ok) outbox_.clear();
    Advance(std::move(lock));
  }

  void OnCancel() override { cancelled_ = true; }
  void OnDone() override { delete this; }

 private:
  enum class Action { kNone, kRead, kWrite, kFinish };

  void Handle(bool is_request) {
    if (cancelled()) return EndStep(absl::CancelledError("the call was cancelled"), true);
    const absl::Status status = RunHandler(is_request);
    EndStep(status, !is_request || !status.ok());
  }

  absl::Status RunHandler(bool is_request) {
    std::lock_guard lock(handler_mutex_);
    return is_request ? handler_->OnRequest(request_, *this) : handler_->OnEnd(*this);
  }

  void EndStep(const absl::Status& status, bool last) {
    std::unique_lock lock(mutex_);
    step_done_ = true;
    if (last) result_ = status;
    Advance(std::move(lock));
  }

  void Send(Response response) override {
    std::unique_lock lock(mutex_);
    outbox_.push_back(std::move(response));
    Advance(std::move(lock));
  }

  bool idle() override {
    std::lock_guard lock(mutex_);
    return outbox_.empty();
  }

  bool cancelled() override { return cancelled_ || context_->IsCancelled(); }

  Action NextAction() {
    if (writing_) return Action::kNone;
    if (cancelled_) outbox_.clear();
    if (!outbox_.empty()) {
      writing_ = true;
      return Action::kWrite;
    }
    if (!step_done_) return Action::kNone;
    step_done_ = false;
    return result_ ? Action::kFinish : Action::kRead;
  }

  /// Starts what comes next. Decided in the same critical section as what led to it, and done
  /// outside: as soon as the lock is free, another thread may finish the call and delete this.
  void Advance(std::unique_lock<std::mutex> lock) {
    const Action action = NextAction();
    if (action == Action::kNone) return;
    const Response* message = action == Action::kWrite ? &outbox_.front() : nullptr;
    lock.unlock();
    switch (action) {
      case Action::kNone:
        return;
      case Action::kRead:
        return this->StartRead(&request_);
      case Action::kWrite:
        return this->StartWrite(message);
      case Action::kFinish:
        return this->Finish(record_->End(*result_));
    }
  }

  grpc::CallbackServerContext* const context_;
  const std::shared_ptr<CallRecord> record_;
  const std::unique_ptr<StreamHandler<Request, Response>> handler_;
  BackgroundExecutor& at_request_;
  BackgroundExecutor& at_end_;
  Request request_;
  std::atomic<bool> cancelled_ = false;
  // Never contended: gRPC brings one step after the other, by locks that the thread sanitizer does
  // not see.
  std::mutex handler_mutex_;

  std::mutex mutex_;
  std::deque<Response> outbox_;  // its front is being written
  bool writing_ = false;
  bool step_done_ = false;  // the handler has returned, what comes next has not begun
  std::optional<absl::Status> result_;
};

}  // namespace metaekf::server
