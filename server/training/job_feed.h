#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <mutex>
#include <string>
#include <utility>

namespace metaekf::server {

/// Tells who watches a job that it may have changed. Safe to call concurrently.
class JobFeed {
 public:
  enum class Event {
    kChanged,
    kClosed,  ///< the server stops: there will be no more
  };
  using Listener = std::function<void(Event)>;
  using Job = std::pair<std::string, int64_t>;  ///< tenant and number

  /// Calls `listener` for every event from now on, from any thread; it must be quick and must not
  /// call the feed. Returns the number to unsubscribe with.
  int64_t Subscribe(const Job& job, Listener listener);
  /// The listener is not called any more when this returns.
  void Unsubscribe(int64_t subscription);

  void Notify(const Job& job);
  /// Tells everyone kClosed, also who subscribes later.
  void Close();

 private:
  struct Subscription {
    Job job;
    Listener listener;
  };

  std::mutex mutex_;
  int64_t next_ = 1;
  bool closed_ = false;
  std::map<int64_t, Subscription> subscriptions_;
};

}  // namespace metaekf::server
