#pragma once

#include <condition_variable>
#include <cstddef>
#include <deque>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace metaekf::server {

/// A few threads that work through a bounded queue: for what must not run in a gRPC reaction, as
/// SQL, files and computations.
class BackgroundExecutor {
 public:
  struct Options {
    size_t threads = 1;
    size_t max_queued = 1024;
    bool gives_way = false;  ///< threads GiveWay
  };
  explicit BackgroundExecutor(const Options& options);
  /// Runs what is queued, then ends.
  ~BackgroundExecutor();

  /// Queues `task`. False if the queue is full: shed the work.
  [[nodiscard]] bool Submit(std::function<void()> task);
  size_t queued() const;
  bool is_full() const { return queued() >= max_queued_; }

 private:
  void Run(bool gives_way);

  const size_t max_queued_;
  mutable std::mutex mutex_;
  std::condition_variable work_ready_;
  std::deque<std::function<void()>> queue_;
  bool stopping_ = false;
  std::vector<std::thread> threads_;
};

}  // namespace metaekf::server
