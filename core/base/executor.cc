#include "core/base/executor.h"

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <thread>
#include <vector>

namespace metaekf::base {
namespace {

class SerialExecutor : public Executor {
 public:
  void ParallelFor(size_t count, const std::function<void(size_t, size_t)>& work) override {
    for (size_t index = 0; index < count; ++index) work(index, 0);
  }
  size_t concurrency() const override { return 1; }
};

/// How long a thread looks for what it waits for before it sleeps. To wake one takes some 50 µs, as long as a piece of a gradient of
/// which there are many, one after the other.
constexpr std::chrono::microseconds kSpin(50);

template <typename Condition>
void SpinUntil(const Condition& condition) {
  const auto end = std::chrono::steady_clock::now() + kSpin;
  while (!condition() && std::chrono::steady_clock::now() < end) {
  }
}

class ThreadExecutor : public Executor {
 public:
  explicit ThreadExecutor(size_t threads) {
    for (size_t slot = 1; slot < threads; ++slot) {
      helpers_.emplace_back([this, slot] { HelperLoop(slot); });
    }
  }

  ~ThreadExecutor() override {
    {
      std::lock_guard lock(mutex_);
      stopping_ = true;
    }
    work_ready_.notify_all();
    for (std::thread& helper : helpers_) helper.join();
  }

  void ParallelFor(size_t count, const std::function<void(size_t, size_t)>& work) override {
    if (count == 0) return;
    std::lock_guard one_at_a_time(batch_mutex_);
    std::unique_lock lock(mutex_);
    work_ = &work;
    next_ = 0;
    count_ = count;
    idle_ = false;
    ++batches_;
    work_ready_.notify_all();
    Drain(lock, 0);
    lock.unlock();
    SpinUntil([this] { return idle_.load(); });
    lock.lock();
    batch_done_.wait(lock, [this] { return busy_ == 0; });
    work_ = nullptr;
  }

  size_t concurrency() const override { return helpers_.size() + 1; }

 private:
  /// Takes pieces until none is left. Entered and left with the lock held.
  void Drain(std::unique_lock<std::mutex>& lock, size_t slot) {
    while (next_ < count_) {
      const size_t index = next_++;
      const auto* work = work_;
      ++busy_;
      lock.unlock();
      (*work)(index, slot);
      lock.lock();
      if (--busy_ == 0 && next_ == count_) {
        idle_ = true;
        batch_done_.notify_one();
      }
    }
  }

  void HelperLoop(size_t slot) {
    std::unique_lock lock(mutex_);
    while (true) {
      work_ready_.wait(lock, [this] { return stopping_ || next_ < count_; });
      if (stopping_) return;
      Drain(lock, slot);
      const uint64_t last = batches_;
      lock.unlock();
      SpinUntil([this, last] { return batches_.load() != last; });
      lock.lock();
    }
  }

  std::mutex batch_mutex_;  // ParallelFor may be called from several threads, one batch at a time
  std::mutex mutex_;
  std::condition_variable work_ready_;
  std::condition_variable batch_done_;
  const std::function<void(size_t, size_t)>* work_ = nullptr;
  size_t next_ = 0;
  size_t count_ = 0;
  size_t busy_ = 0;
  bool stopping_ = false;
  // What spinning threads look at; written with the mutex held.
  std::atomic<uint64_t> batches_ = 0;
  std::atomic<bool> idle_ = true;
  std::vector<std::thread> helpers_;
};

}  // namespace

Executor* CallingThread() {
  static SerialExecutor executor;
  return &executor;
}

std::unique_ptr<Executor> MakeThreadExecutor(size_t threads) {
  return std::make_unique<ThreadExecutor>(threads);
}

}  // namespace metaekf::base
