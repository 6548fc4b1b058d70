#pragma once

#include <condition_variable>
#include <memory>
#include <mutex>
#include <thread>

namespace grpc {
class Channel;
}

namespace metaekf::server {

/// Calls the server's own health service every 0.3 s. The threads behind gRPC's callback API sleep
/// for 0.1 s whenever they had nothing to do for a second; this keeps them from it, so that a
/// sensor that sends once a second is not answered late.
class KeepWarm {
 public:
  explicit KeepWarm(std::shared_ptr<grpc::Channel> channel);
  ~KeepWarm();

 private:
  void Run();

  const std::shared_ptr<grpc::Channel> channel_;
  std::mutex mutex_;
  std::condition_variable stop_;
  bool stopping_ = false;
  std::thread thread_;
};

}  // namespace metaekf::server
