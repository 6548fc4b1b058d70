#pragma once

#include <grpcpp/support/server_callback.h>

#include <memory>
#include <utility>

#include "server/executor/background_executor.h"
#include "server/handlers/overload.h"
#include "server/handlers/stream_handler.h"
#include "server/status/grpc_status.h"

namespace metaekf::server {

/// Runs a ResponseSource on a server-streaming call, as fast as the client reads. Owns itself until
/// the call is done.
template <class Response>
class DownloadCall final : public grpc::ServerWriteReactor<Response> {
 public:
  DownloadCall(std::unique_ptr<ResponseSource<Response>> source, BackgroundExecutor& executor)
      : source_(std::move(source)) {
    const bool accepted = executor.Submit([this] {
      const absl::Status status = source_->Open();
      if (!status.ok()) return this->Finish(ToGrpcStatus(status));
      WriteNext();
    });
    if (!accepted) this->Finish(ToGrpcStatus(Overloaded()));
  }

  void OnWriteDone(bool ok) override {
    if (ok) return WriteNext();
    this->Finish(grpc::Status::CANCELLED);
  }
  void OnDone() override { delete this; }

 private:
  void WriteNext() {
    response_.Clear();
    if (source_->Next(&response_)) return this->StartWrite(&response_);
    this->Finish(grpc::Status::OK);
  }

  const std::unique_ptr<ResponseSource<Response>> source_;
  Response response_;
};

}  // namespace metaekf::server
