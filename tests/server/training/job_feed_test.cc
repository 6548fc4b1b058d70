#include "server/training/job_feed.h"

#include <gtest/gtest.h>

#include <vector>

namespace metaekf::server {
namespace {

using Event = JobFeed::Event;

TEST(JobFeedTest, TellsTheWatchersOfTheJobOnly) {
  JobFeed feed;
  std::vector<Event> first, second;
  const int64_t subscription = feed.Subscribe({"default", 1}, [&](Event event) { first.push_back(event); });
  feed.Subscribe({"default", 2}, [&](Event event) { second.push_back(event); });
  feed.Notify({"default", 1});
  feed.Unsubscribe(subscription);
  feed.Notify({"default", 1});
  EXPECT_EQ(first, (std::vector<Event>{Event::kChanged}));
  EXPECT_TRUE(second.empty());
}

TEST(JobFeedTest, ClosingTellsAllAlsoThoseWhoComeLater) {
  JobFeed feed;
  std::vector<Event> early, late;
  feed.Subscribe({"default", 1}, [&](Event event) { early.push_back(event); });
  feed.Close();
  feed.Subscribe({"default", 1}, [&](Event event) { late.push_back(event); });
  EXPECT_EQ(early, (std::vector<Event>{Event::kClosed}));
  EXPECT_EQ(late, (std::vector<Event>{Event::kClosed}));
}

}  // namespace
}  // namespace metaekf::server
