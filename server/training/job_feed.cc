#include "server/training/job_feed.h"

#include <utility>

namespace metaekf::server {

int64_t JobFeed::Subscribe(const Job& job, Listener listener) {
  std::lock_guard lock(mutex_);
  if (closed_) listener(Event::kClosed);
  subscriptions_[next_] = {job, std::move(listener)};
  return next_++;
}

void JobFeed::Unsubscribe(int64_t subscription) {
  std::lock_guard lock(mutex_);
  subscriptions_.erase(subscription);
}

void JobFeed::Notify(const Job& job) {
  std::lock_guard lock(mutex_);
  for (const auto& [number, subscription] : subscriptions_) {
    if (subscription.job == job) subscription.listener(Event::kChanged);
  }
}

void JobFeed::Close() {
  std::lock_guard lock(mutex_);
  closed_ = true;
  for (const auto& [number, subscription] : subscriptions_) {
    subscription.listener(Event::kClosed);
  }
}

}  // namespace metaekf::server
