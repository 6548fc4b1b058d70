#include "server/keep_warm.h"

#include <grpcpp/channel.h>
#include <grpcpp/client_context.h>

#include <chrono>

#include "grpc/health/v1/health.grpc.pb.h"

namespace metaekf::server {
namespace {

constexpr std::chrono::milliseconds kPeriod(300);

}  // namespace

KeepWarm::KeepWarm(std::shared_ptr<grpc::Channel> channel)
    : channel_(std::move(channel)), thread_([this] { Run(); }) {}

KeepWarm::~KeepWarm() {
  {
    std::lock_guard lock(mutex_);
    stopping_ = true;
  }
  stop_.notify_all();
  thread_.join();
}

void KeepWarm::Run() {
  const auto health = grpc::health::v1::Health::NewStub(channel_);
  std::unique_lock lock(mutex_);
  while (!stop_.wait_for(lock, kPeriod, [this] { return stopping_; })) {
    lock.unlock();
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + kPeriod);
    grpc::health::v1::HealthCheckResponse response;
    // Whatever the answer, it was an event.
    (void)health->Check(&context, {}, &response);
    lock.lock();
  }
}

}  // namespace metaekf::server
