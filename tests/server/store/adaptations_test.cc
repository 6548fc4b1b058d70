#include "server/store/adaptations.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/server/store/test_store.h"

namespace metaekf::store {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

class AdaptationsTest : public StoreTest {
 protected:
  void SetUp() override {
    StoreTest::SetUp();
    AddVersion("robot");
  }
  absl::StatusOr<Adaptation> Create(const std::string& id, const RequestId& request = {}) {
    return Mine().adaptations().Create(
        {id, "robot", 1, Blob("subset"), R"({"steps": 5})", request});
  }
};

TEST_F(AdaptationsTest, AnAdaptationIsReadBackAsItWasMade) {
  ASSERT_TRUE(Create("arm").ok());
  Reopen();
  const auto adaptation = Mine().adaptations().Get("arm");
  ASSERT_TRUE(adaptation.ok()) << adaptation.status();
  EXPECT_EQ(adaptation->id, "arm");
  EXPECT_EQ(adaptation->model, "robot");
  EXPECT_EQ(adaptation->version, 1);
  EXPECT_EQ(adaptation->digest, Sha256Hex("subset"));
  EXPECT_EQ(adaptation->size_bytes, 6);
  EXPECT_EQ(adaptation->receipt_json, R"({"steps": 5})");
  EXPECT_EQ(adaptation->create_time, now_);
  EXPECT_EQ(Mine().adaptations().ReadFile(*adaptation).value(), "subset");
}

TEST_F(AdaptationsTest, ChoosesIdsThatAreFree) {
  ASSERT_TRUE(Create("a2").ok());
  EXPECT_EQ(Create("")->id, "a1");
  EXPECT_EQ(Create("")->id, "a3");
  ASSERT_TRUE(Mine().adaptations().Delete("a3").ok());
  EXPECT_EQ(Create("")->id, "a4");
}

TEST_F(AdaptationsTest, ATakenIdIsRefused) {
  ASSERT_TRUE(Create("arm").ok());
  EXPECT_EQ(Create("arm").status().code(), absl::StatusCode::kAlreadyExists);
}

TEST_F(AdaptationsTest, TheSameRequestMakesOneAdaptation) {
  const RequestId request{"id-1", "print"};
  EXPECT_FALSE(Mine().adaptations().FindByRequest(request)->has_value());
  ASSERT_EQ(Create("", request)->id, "a1");
  EXPECT_EQ(Create("", request)->id, "a1");
  EXPECT_EQ(Mine().adaptations().FindByRequest(request)->value().id, "a1");
  EXPECT_EQ(Mine().adaptations().FindByRequest({"id-1", "other"}).status().code(),
            absl::StatusCode::kAlreadyExists);
}

TEST_F(AdaptationsTest, ListsByIdInPages) {
  for (const char* id : {"c", "a", "b"}) ASSERT_TRUE(Create(id).ok());
  const auto first = Mine().adaptations().List({2, ""});
  ASSERT_TRUE(first.ok());
  std::vector<std::string> ids;
  for (const auto& adaptation : first->items) ids.push_back(adaptation.id);
  const auto second = Mine().adaptations().List({2, first->next_page_token});
  ASSERT_TRUE(second.ok());
  for (const auto& adaptation : second->items) ids.push_back(adaptation.id);
  EXPECT_THAT(ids, ElementsAre("a", "b", "c"));
}

TEST_F(AdaptationsTest, DeletingRemovesTheFile) {
  const auto adaptation = Create("arm");
  ASSERT_TRUE(Mine().adaptations().Delete("arm").ok());
  EXPECT_FALSE(BlobExists(adaptation->digest));
  EXPECT_EQ(Mine().adaptations().Get("arm").status().code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(Mine().adaptations().ReadFile(*adaptation).status().code(),
            absl::StatusCode::kNotFound);
  EXPECT_EQ(Mine().adaptations().Delete("arm").code(), absl::StatusCode::kNotFound);
}

TEST_F(AdaptationsTest, ADamagedFileIsDataLossThatNamesTheAdaptation) {
  const auto adaptation = Create("arm");
  FlipBit(adaptation->digest);
  const absl::Status status = Mine().adaptations().ReadFile(*adaptation).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kDataLoss);
  EXPECT_THAT(std::string(status.message()), HasSubstr("adaptation 'arm'"));
}

TEST_F(AdaptationsTest, NeedsItsVersionAndAProperId) {
  const auto lost = Mine().adaptations().Create({"arm", "robot", 7, Blob("x"), "{}", {}});
  EXPECT_EQ(lost.status().code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(Create("../arm").status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(Mine().adaptations().Get("../arm").status().code(),
            absl::StatusCode::kInvalidArgument);
}

}  // namespace
}  // namespace metaekf::store
