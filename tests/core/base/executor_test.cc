#include "core/base/executor.h"

#include <gtest/gtest.h>

#include <atomic>
#include <vector>

namespace metaekf::base {
namespace {

TEST(ExecutorTest, EveryIndexRunsExactlyOnce) {
  for (size_t threads : {1, 2, 5}) {
    auto executor = MakeThreadExecutor(threads);
    for (size_t count : {0, 1, 3, 1000}) {
      std::vector<std::atomic<int>> calls(count);
      executor->ParallelFor(count, [&](size_t index, size_t slot) {
        EXPECT_LT(slot, threads);
        ++calls[index];
      });
      for (const auto& n : calls) EXPECT_EQ(n, 1);
    }
  }
}

TEST(ExecutorTest, SlotsAreNeverShared) {
  auto executor = MakeThreadExecutor(4);
  std::vector<std::atomic<int>> users(4);
  executor->ParallelFor(2000, [&](size_t, size_t slot) {
    EXPECT_EQ(users[slot].fetch_add(1), 0);
    users[slot].fetch_sub(1);
  });
}

TEST(ExecutorTest, SerialRunsInOrder) {
  std::vector<size_t> order;
  CallingThread()->ParallelFor(4, [&](size_t index, size_t) { order.push_back(index); });
  EXPECT_EQ(order, (std::vector<size_t>{0, 1, 2, 3}));
}

}  // namespace
}  // namespace metaekf::base
