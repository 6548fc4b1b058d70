#include "server/executor/background_executor.h"

#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <utility>

namespace metaekf::server {

BackgroundExecutor::BackgroundExecutor(const Options& options) : max_queued_(options.max_queued) {
  for (size_t i = 0; i < options.threads; ++i) {
    threads_.emplace_back([this, nice = options.nice] { Run(nice); });
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

void BackgroundExecutor::Run(int nice) {
  // On Linux the priority is the thread's own. Without it the thread works all the same.
  if (nice != 0) {
    (void)setpriority(PRIO_PROCESS, static_cast<id_t>(syscall(SYS_gettid)), nice);
  }
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
