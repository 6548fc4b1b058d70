#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <mutex>

namespace metaekf::server {

/// Tells who watches a job that it may have changed. Safe to call concurrently.
class JobFeed {
 public:
  enum class Event {
    kChanged,
    kClosed,  ///< the server stops: there will be no more
  };
  using Listener = std::function<void(Event)>;

  /// Calls `listener` for every event from now on, from any thread; it must be quick and must not
  /// call the feed. Returns the number to unsubscribe with.
  int64_t Subscribe(int64_t job, Listener listener);
  /// The listener is not called any more when this returns.
  void Unsubscribe(int64_t subscription);

  void Notify(int64_t job);
  /// Tells everyone kClosed, also who subscribes later.
  void Close();

 private:
  struct Subscription {
    int64_t job;
    Listener listener;
  };

  std::mutex mutex_;
  int64_t next_ = 1;
  bool closed_ = false;
  std::map<int64_t, Subscription> subscriptions_;
};

}  // namespace metaekf::server
