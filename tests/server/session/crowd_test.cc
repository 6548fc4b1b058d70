#include "server/session/crowd.h"

#include <gtest/gtest.h>

#include <array>

namespace metaekf::server {
namespace {

using std::chrono::microseconds;

class CrowdTest : public ::testing::Test {
 protected:
  /// A batch of each of so many streams, so long after the one before. @return how many of them joined a crowd.
  int Joined(size_t streams, microseconds after) {
    int joined = 0;
    for (size_t stream = 0; stream < streams; ++stream) joined += crowd_.Joins(now_ += after, &rushes_[stream]);
    return joined;
  }

  std::chrono::steady_clock::time_point now_{std::chrono::hours(1)};
  Crowd crowd_;
  std::array<uint64_t, 20> rushes_{};
};

TEST_F(CrowdTest, IsManyStreamsOneUponTheOther) { EXPECT_EQ(Joined(20, microseconds(50)), 12) << "all but the first eight"; }

TEST_F(CrowdTest, IsNotFewStreamsHoweverMuchTheySend) {
  for (int round = 0; round < 100; ++round) EXPECT_EQ(Joined(8, microseconds(1)), 0) << round;
}

TEST_F(CrowdTest, EndsWithAPause) {
  EXPECT_GT(Joined(20, microseconds(50)), 0);
  now_ += std::chrono::milliseconds(2);
  EXPECT_EQ(Joined(8, microseconds(50)), 0);
  EXPECT_EQ(Joined(20, std::chrono::milliseconds(2)), 0) << "each after a pause";
}

}  // namespace
}  // namespace metaekf::server
