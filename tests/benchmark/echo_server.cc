// The bare server beside which the real one is measured: the same callback API, one read and one write in flight.

#include <grpcpp/grpcpp.h>

#include <cstdio>

#include "absl/synchronization/mutex.h"
#include "echo.grpc.pb.h"

namespace metaekf::benchmark {
namespace {

class Stream final : public grpc::ServerBidiReactor<EchoRequest, EchoReply> {
 public:
  Stream() { StartRead(&request_); }
  void OnReadDone(bool ok) override {
    if (!ok) return Finish(grpc::Status::OK);
    reply_.mutable_payload()->resize(request_.reply_bytes());
    StartWrite(&reply_);
  }
  void OnWriteDone(bool ok) override {
    if (!ok) return Finish(grpc::Status::OK);
    StartRead(&request_);
  }
  void OnDone() override { delete this; }

 private:
  EchoRequest request_;
  EchoReply reply_;
};

class Service final : public Echo::CallbackService {
  grpc::ServerBidiReactor<EchoRequest, EchoReply>* Stream(grpc::CallbackServerContext*) override {
    return new benchmark::Stream;
  }
};

}  // namespace
}  // namespace metaekf::benchmark

int main() {
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);  // as metaekfd does
  metaekf::benchmark::Service service;
  int port = 0;
  grpc::ServerBuilder builder;
  builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(), &port);
  builder.RegisterService(&service);
  const std::unique_ptr<grpc::Server> server = builder.BuildAndStart();
  if (server == nullptr) return 1;
  std::printf("listening on 127.0.0.1:%d\n", port);
  std::fflush(stdout);
  server->Wait();
}
