#include "server/executor/background_executor.h"

#include <utility>

#include "server/executor/give_way.h"

namespace metaekf::server {

BackgroundExecutor::BackgroundExecutor(const Options& options) : max_queued_(options.max_queued) {
  for (size_t i = 0; i < options.threads; ++i) {
    threads_.emplace_back([this, gives_way = options.gives_way] { Run(gives_way); });
  }
}

BackgroundExecutor::~BackgroundExecutor() {
  {
    std::lock_guard lock(mutex_);
    stopping_ = true;
  }
  work_ready_.notify_all();
  for (std::thread& thread : threads_) thread.join();
}

bool BackgroundExecutor::Submit(std::function<void()> task) {
  {
    std::lock_guard lock(mutex_);
    if (queue_.size() >= max_queued_) return false;
    queue_.push_back(std::move(task));
  }
  work_ready_.notify_one();
  return true;
}

size_t BackgroundExecutor::queued() const {
  std::lock_guard lock(mutex_);
  return queue_.size();
}

void BackgroundExecutor::Run(bool gives_way) {
  if (gives_way) GiveWay();
  std::unique_lock lock(mutex_);
  while (true) {
    work_ready_.wait(lock, [this] { return stopping_ || !queue_.empty(); });
    if (queue_.empty()) return;
    const std::function<void()> task = std::move(queue_.front());
    queue_.pop_front();
    lock.unlock();
    task();
    lock.lock();
  }
}

}  // namespace metaekf::server
