#include "server/convert/sample_budget.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <limits>
#include <optional>

namespace metaekf::server {
namespace {

using ::testing::HasSubstr;

TEST(SampleBudgetTest, SharesTogetherStayWithinItAndAreGivenBack) {
  SampleBudget budget(100);
  SampleBudget::Share mine(budget);
  std::optional<SampleBudget::Share> other(std::in_place, budget);
  EXPECT_TRUE(other->Grow(60).ok());
  EXPECT_TRUE(mine.Grow(40).ok());
  const absl::Status full = mine.Grow(1);
  EXPECT_EQ(full.code(), absl::StatusCode::kResourceExhausted);
  EXPECT_THAT(std::string(full.message()), HasSubstr("try again in a second"));
  mine.ShrinkTo(30);
  EXPECT_TRUE(mine.Grow(10).ok());
  other.reset();
  EXPECT_TRUE(mine.Grow(60).ok());
}

TEST(SampleBudgetTest, WhatIsTooMuchOnItsOwnIsSaidToBe) {
  SampleBudget budget(100);
  SampleBudget::Share share(budget);
  EXPECT_TRUE(share.Grow(60).ok());
  for (const int64_t bytes : {int64_t{41}, std::numeric_limits<int64_t>::max()}) {
    const absl::Status status = share.Grow(bytes);
    EXPECT_EQ(status.code(), absl::StatusCode::kResourceExhausted);
    EXPECT_THAT(std::string(status.message()), HasSubstr("more than 100 bytes, this server's limits.sample_bytes"));
  }
  EXPECT_TRUE(share.Grow(40).ok());
}

}  // namespace
}  // namespace metaekf::server
