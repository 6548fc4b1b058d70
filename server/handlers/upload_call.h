#pragma once

#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

#include <atomic>
#include <memory>
#include <mutex>
#include <utility>

#include "server/executor/background_executor.h"
#include "server/handlers/call_record.h"
#include "server/handlers/overload.h"
#include "server/handlers/stream_handler.h"

namespace metaekf::server {

/// Runs a StreamHandler that sends one response, at its end, on a client-streaming call. Owns
/// itself until the call is done.
template <class Request, class Response>
class UploadCall final : public grpc::ServerReadReactor<Request>, private ResponseSink<Response> {
 public:
  UploadCall(grpc::CallbackServerContext* context, std::shared_ptr<CallRecord> record,
             std::unique_ptr<StreamHandler<Request, Response>> handler,
             BackgroundExecutor& executor, Response* response)
      : context_(context), record_(std::move(record)), handler_(std::move(handler)), executor_(executor), response_(response) {
    this->StartRead(&request_);
  }

  void OnReadDone(bool ok) override {
    if (!executor_.Submit([this, ok] { Handle(ok); })) this->Finish(record_->End(Overloaded()));
  }
  void OnCancel() override { cancelled_ = true; }
  void OnDone() override { delete this; }

 private:
  void Handle(bool is_request) {
    if (cancelled()) return this->Finish(record_->End(absl::CancelledError("the call was cancelled")));
    const absl::Status status = RunHandler(is_request);
    if (is_request && status.ok()) return this->StartRead(&request_);
    this->Finish(record_->End(status));
  }

  absl::Status RunHandler(bool is_request) {
    std::lock_guard lock(handler_mutex_);
    return is_request ? handler_->OnRequest(request_, *this) : handler_->OnEnd(*this);
  }

  void Send(Response response) override { *response_ = std::move(response); }
  bool idle() override { return true; }
  bool cancelled() override { return cancelled_ || context_->IsCancelled(); }

  grpc::CallbackServerContext* const context_;
  const std::shared_ptr<CallRecord> record_;
  const std::unique_ptr<StreamHandler<Request, Response>> handler_;
  BackgroundExecutor& executor_;
  Response* const response_;
  Request request_;
  std::atomic<bool> cancelled_ = false;
  // Never contended: gRPC brings one step after the other, by locks that the thread sanitizer does
  // not see.
  std::mutex handler_mutex_;
};

}  // namespace metaekf::server
