#include "server/store/page.h"

#include <gtest/gtest.h>

namespace metaekf::store {
namespace {

TEST(PageTest, SizesHaveADefaultAndALimit) {
  EXPECT_EQ(ParsePage("models", {0, ""})->size, 50);
  EXPECT_EQ(ParsePage("models", {7, ""})->size, 7);
  EXPECT_EQ(ParsePage("models", {1'000'000, ""})->size, 1000);
  EXPECT_EQ(ParsePage("models", {-1, ""}).status().code(), absl::StatusCode::kInvalidArgument);
}

TEST(PageTest, ATokenCarriesTheLastKeyOfItsListOnly) {
  const std::string token = MakePageToken("models", "robot");
  EXPECT_EQ(ParsePage("models", {0, token})->after, "robot");
  EXPECT_EQ(ParsePage("jobs", {0, token}).status().code(), absl::StatusCode::kInvalidArgument);
}

TEST(PageTest, RefusesTokensThatNoListGave) {
  for (const char* token : {"x", "robot", "!!!!", "AAAAAAAAAAAAAAAA"}) {
    EXPECT_EQ(ParsePage("models", {0, token}).status().code(), absl::StatusCode::kInvalidArgument);
  }
}

TEST(PageTest, OneItemTooManyMakesANextPage) {
  const auto key = [](int item) { return std::to_string(item); };
  const PageCursor cursor{2, ""};
  EXPECT_EQ(MakePage("jobs", cursor, std::vector{9, 8}, key).next_page_token, "");
  const auto page = MakePage("jobs", cursor, std::vector{9, 8, 7}, key);
  EXPECT_EQ(page.items, (std::vector{9, 8}));
  EXPECT_EQ(NumberLimit(*ParsePage("jobs", {0, page.next_page_token})), 8);
}

}  // namespace
}  // namespace metaekf::store
