#include "server/executor/background_executor.h"

#include <gtest/gtest.h>

#include <atomic>
#include <future>

namespace metaekf::server {
namespace {

TEST(BackgroundExecutorTest, RunsWhatItTook) {
  std::atomic<int> done = 0;
  {
    BackgroundExecutor executor({.threads = 3});
    for (int i = 0; i < 100; ++i) ASSERT_TRUE(executor.Submit([&] { ++done; }));
  }
  EXPECT_EQ(done, 100);
}

TEST(BackgroundExecutorTest, RefusesWhatDoesNotFit) {
  std::promise<void> started, release;  // which what it runs uses until it is gone
  BackgroundExecutor executor({.threads = 1, .max_queued = 2});
  ASSERT_TRUE(executor.Submit([&] {
    started.set_value();
    release.get_future().wait();
  }));
  started.get_future().wait();
  EXPECT_TRUE(executor.Submit([] {}));
  EXPECT_TRUE(executor.Submit([] {}));
  EXPECT_FALSE(executor.Submit([] {}));
  EXPECT_EQ(executor.queued(), 2u);
  release.set_value();
}

}  // namespace
}  // namespace metaekf::server
