#include <grpcpp/generic/generic_stub.h>
#include <grpcpp/grpcpp.h>
#include <spdlog/spdlog.h>

#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <memory>

#include "core/nssm/model_file.h"
#include "server/server.h"
#include "tests/fuzz/request_frames.h"
#include "tests/server/support/server_test.h"
#include "tests/server/support/tiny_models.h"

namespace metaekf::server {
namespace {

/// A server with something of everything, and a client that sends bytes.
class Target {
 public:
  Target() {
    spdlog::set_level(spdlog::level::off);
    if (mkdtemp(directory_) == nullptr) std::abort();
    ServerOptions options;
    options.data_directory = directory_;
    options.listen = "127.0.0.1:0";
    options.training.worker_binary = "/bin/false";
    options.training.max_queued_jobs = 1;
    server_ = Server::Start(options).value();
    Client client(server_->address());
    const bool imported = client.Import(ImportRequests("io", nssm::WriteModelFile(TinyBundle()))).ok() &&
                          client.Import(ImportRequests("states", nssm::WriteModelFile(TinyStateBundle()))).ok();
    v1::AdaptRequest options_message, samples;
    options_message.mutable_options()->set_model("models/io");
    options_message.mutable_options()->set_adaptation_id("mine");
    *samples.mutable_samples() = TinyContext(30);
    if (!imported || !client.Adapt({options_message, samples}).ok()) std::abort();
    stub_ = std::make_unique<grpc::GenericStub>(grpc::CreateChannel(server_->address(), grpc::InsecureChannelCredentials()));
  }
  ~Target() {
    stub_.reset();
    server_.reset();
    std::error_code ignored;
    std::filesystem::remove_all(directory_, ignored);
  }

  grpc::Status Call(const std::string& method, const std::vector<std::string>& messages) {
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(10));
    const auto call = stub_->PrepareCall(&context, method, &queue_);
    call->StartCall(nullptr);
    bool going = Wait();
    for (size_t m = 0; m < messages.size() && going; ++m) {
      const grpc::Slice slice(messages[m]);
      call->Write(grpc::ByteBuffer(&slice, 1), nullptr);
      going = Wait();
    }
    if (going) {
      call->WritesDone(nullptr);
      Wait();
    }
    grpc::ByteBuffer response;
    do {
      call->Read(&response, nullptr);
    } while (Wait());
    grpc::Status status;
    call->Finish(&status, nullptr);
    Wait();
    return status;
  }

 private:
  bool Wait() {
    void* tag = nullptr;
    bool ok = false;
    return queue_.Next(&tag, &ok) && ok;
  }

  char directory_[32] = "/dev/shm/metaekf-fuzz-XXXXXX";
  std::unique_ptr<Server> server_;
  std::unique_ptr<grpc::GenericStub> stub_;
  grpc::CompletionQueue queue_;
};

/// A new one now and then, or what was made would fill the memory.
Target& TargetOfRun() {
  static std::unique_ptr<Target> target;
  static int runs = 0;
  if (runs++ % 20'000 == 0) {
    target.reset();
    target = std::make_unique<Target>();
  }
  return *target;
}

}  // namespace
}  // namespace metaekf::server

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  static const std::vector<std::string> methods = metaekf::testing::AllMethods();
  if (size == 0) return 0;
  const std::string& method = methods[data[0] % methods.size()];
  const std::string_view bytes(reinterpret_cast<const char*>(data), size);
  const grpc::Status status = metaekf::server::TargetOfRun().Call(method, metaekf::testing::ToMessages(bytes));
  const bool may_wait = method.ends_with("/WatchJob");  // for a job that has not ended
  if (status.error_code() == grpc::StatusCode::UNKNOWN ||
      (status.error_code() == grpc::StatusCode::DEADLINE_EXCEEDED && !may_wait)) {
    std::fprintf(stderr, "%s: %d %s\n", method.c_str(), status.error_code(), status.error_message().c_str());
    std::abort();
  }
  return 0;
}
