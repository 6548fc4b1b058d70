#pragma once

#include <grpcpp/support/server_callback.h>

#include <functional>
#include <memory>
#include <mutex>
#include <utility>

#include "server/executor/background_executor.h"
#include "server/handlers/call_record.h"
#include "server/handlers/overload.h"
#include "server/handlers/stream_handler.h"

namespace metaekf::server {

/// Runs a ResponseSource on a server-streaming call, as fast as the client reads. Owns itself until
/// the call is done.
template <class Response>
class DownloadCall final : public grpc::ServerWriteReactor<Response> {
 public:
  DownloadCall(std::shared_ptr<CallRecord> record, std::unique_ptr<ResponseSource<Response>> source,
               BackgroundExecutor& executor)
      : record_(std::move(record)), source_(std::move(source)), executor_(executor) {
    Submit([this] {
      const absl::Status status = Open();
      if (!status.ok()) return this->Finish(record_->End(status));
      WriteNext();
    });
  }

  void OnWriteDone(bool ok) override {
    if (ok) return Submit([this] { WriteNext(); });
    this->Finish(record_->End(absl::CancelledError("the call was cancelled")));
  }
  void OnDone() override {
    { std::lock_guard lock(mutex_); }
    delete this;
  }

 private:
  void Submit(std::function<void()> step) {
    if (!executor_.Submit(std::move(step))) this->Finish(record_->End(Overloaded()));
  }

  absl::Status Open() {
    std::lock_guard lock(mutex_);
    return source_->Open();
  }

  void WriteNext() {
    const absl::StatusOr<bool> more = StartNext();
    if (!more.ok() || !*more) this->Finish(record_->End(more.status()));
  }

  absl::StatusOr<bool> StartNext() {
    std::lock_guard lock(mutex_);
    response_.Clear();
    const absl::StatusOr<bool> more = source_->Next(&response_);
    if (more.ok() && *more) this->StartWrite(&response_);
    return more;
  }

  const std::shared_ptr<CallRecord> record_;
  const std::unique_ptr<ResponseSource<Response>> source_;
  BackgroundExecutor& executor_;
  // Never contended: gRPC brings one step after the other, by locks that the thread sanitizer does not see.
  std::mutex mutex_;
  Response response_;
};

}  // namespace metaekf::server
