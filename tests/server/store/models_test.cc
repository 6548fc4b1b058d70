#include "server/store/models.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <set>
#include <thread>

#include "absl/strings/str_cat.h"
#include "tests/server/store/test_store.h"

namespace metaekf::store {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

using ModelsTest = StoreTest;

std::vector<std::string> Names(const Page<Model>& page) {
  std::vector<std::string> names;
  for (const Model& model : page.items) names.push_back(model.name);
  return names;
}

TEST_F(ModelsTest, AVersionIsReadBackAsItWasAdded) {
  const auto added = Mine().models().AddVersion("robot", Blob("weights"), R"({"n": 3})");
  ASSERT_TRUE(added.ok()) << added.status();
  Reopen();
  const auto version = Mine().models().GetVersion("robot", 1);
  ASSERT_TRUE(version.ok()) << version.status();
  EXPECT_EQ(version->model, "robot");
  EXPECT_EQ(version->version, 1);
  EXPECT_EQ(version->digest, Sha256Hex("weights"));
  EXPECT_EQ(version->size_bytes, 7);
  EXPECT_EQ(version->metadata_json, R"({"n": 3})");
  EXPECT_EQ(version->create_time, now_);
  EXPECT_EQ(Mine().models().ReadFile(*version).value(), "weights");
}

TEST_F(ModelsTest, AModelTellsItsVersionsAndAliases) {
  AddVersion("robot", "one");
  now_ += absl::Hours(1);
  AddVersion("robot", "two");
  ASSERT_TRUE(Mine().models().SetAlias("robot", "stable", 1).ok());
  ASSERT_TRUE(Mine().models().SetAlias("robot", "beta", 2).ok());
  const auto model = Mine().models().Get("robot");
  ASSERT_TRUE(model.ok()) << model.status();
  EXPECT_EQ(model->latest_version, 2);
  EXPECT_EQ(model->version_count, 2);
  EXPECT_EQ(model->create_time, now_ - absl::Hours(1));
  ASSERT_EQ(model->aliases.size(), 2);
  EXPECT_EQ(model->aliases[0].alias, "beta");
  EXPECT_EQ(model->aliases[1].version, 1);
  EXPECT_EQ(Mine().models().GetLatest("robot")->version, 2);
  EXPECT_EQ(Mine().models().GetByAlias("robot", "stable")->digest, Sha256Hex("one"));
}

TEST_F(ModelsTest, SettingAnAliasAgainMovesIt) {
  AddVersion("robot");
  AddVersion("robot");
  ASSERT_TRUE(Mine().models().SetAlias("robot", "stable", 1).ok());
  ASSERT_TRUE(Mine().models().SetAlias("robot", "stable", 2).ok());
  EXPECT_EQ(Mine().models().GetByAlias("robot", "stable")->version, 2);
  ASSERT_TRUE(Mine().models().DeleteAlias("robot", "stable").ok());
  EXPECT_EQ(Mine().models().GetByAlias("robot", "stable").status().code(),
            absl::StatusCode::kNotFound);
}

TEST_F(ModelsTest, VersionNumbersAreNeverGivenTwice) {
  AddVersion("robot");
  AddVersion("robot");
  ASSERT_TRUE(Mine().models().DeleteVersion("robot", 2).ok());
  EXPECT_EQ(AddVersion("robot").version, 3);
  ASSERT_TRUE(Mine().models().DeleteVersion("robot", 1).ok());
  ASSERT_TRUE(Mine().models().DeleteVersion("robot", 3).ok());
  EXPECT_EQ(Mine().models().Get("robot").status().code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(AddVersion("robot").version, 4);
}

TEST_F(ModelsTest, TheSameRequestMakesOneVersion) {
  const RequestId request{"id-1", "print"};
  const auto first = Mine().models().AddVersion("robot", Blob("w"), "{}", request);
  Reopen();
  const auto again = Mine().models().AddVersion("robot", Blob("w"), "{}", request);
  ASSERT_TRUE(again.ok()) << again.status();
  EXPECT_EQ(again->version, first->version);
  EXPECT_EQ(Mine().models().Get("robot")->version_count, 1);
}

TEST_F(ModelsTest, ARequestIdIsForOneRequest) {
  ASSERT_TRUE(Mine().models().AddVersion("robot", Blob("w"), "{}", {"id-1", "print"}).ok());
  const auto other = Mine().models().AddVersion("robot", Blob("v"), "{}", {"id-1", "other"});
  EXPECT_EQ(other.status().code(), absl::StatusCode::kAlreadyExists);
  const auto too_long =
      Mine().models().AddVersion("robot", Blob("v"), "{}", {std::string(129, 'x'), "other"});
  EXPECT_EQ(too_long.status().code(), absl::StatusCode::kInvalidArgument);
}

TEST_F(ModelsTest, ARequestIdIsForgottenAfterAWeek) {
  ASSERT_TRUE(Mine().models().AddVersion("robot", Blob("w"), "{}", {"id-1", "print"}).ok());
  now_ += absl::Hours(24 * 8);
  ASSERT_TRUE(Mine().models().AddVersion("robot", Blob("w"), "{}", {"id-2", "print"}).ok());
  EXPECT_EQ(Mine().models().AddVersion("robot", Blob("w"), "{}", {"id-1", "print"})->version, 3);
}

TEST_F(ModelsTest, PagesHoldEveryModelOnceWhateverHappensInBetween) {
  for (const char* name : {"b", "d", "f", "h"}) AddVersion(name);
  const auto first = Mine().models().List({2, ""});
  ASSERT_TRUE(first.ok());
  EXPECT_THAT(Names(*first), ElementsAre("b", "d"));
  AddVersion("a");  // before the place where the next page begins: not on it
  AddVersion("g");
  ASSERT_TRUE(Mine().models().DeleteVersion("d", 1).ok());
  const auto second = Mine().models().List({10, first->next_page_token});
  ASSERT_TRUE(second.ok());
  EXPECT_THAT(Names(*second), ElementsAre("f", "g", "h"));
  EXPECT_EQ(second->next_page_token, "");
}

TEST_F(ModelsTest, VersionsComeNewestFirstInPages) {
  for (int i = 0; i < 5; ++i) AddVersion("robot");
  std::vector<int64_t> numbers;
  std::string token;
  do {
    const auto page = Mine().models().ListVersions("robot", {2, token});
    ASSERT_TRUE(page.ok()) << page.status();
    for (const auto& version : page->items) numbers.push_back(version.version);
    token = page->next_page_token;
  } while (!token.empty());
  EXPECT_THAT(numbers, ElementsAre(5, 4, 3, 2, 1));
}

TEST_F(ModelsTest, AListWithoutModelsIsEmpty) {
  const auto page = Mine().models().List({});
  ASSERT_TRUE(page.ok());
  EXPECT_TRUE(page->items.empty());
  EXPECT_EQ(page->next_page_token, "");
}

TEST_F(ModelsTest, AVersionInUseIsNotDeleted) {
  AddVersion("robot");
  ASSERT_TRUE(Mine().models().SetAlias("robot", "stable", 1).ok());
  absl::Status status = Mine().models().DeleteVersion("robot", 1);
  EXPECT_EQ(status.code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_THAT(std::string(status.message()), HasSubstr("alias stable"));
  ASSERT_TRUE(Mine().models().DeleteAlias("robot", "stable").ok());

  ASSERT_TRUE(Mine().adaptations().Create({"arm", "robot", 1, Blob("subset"), "{}", {}}).ok());
  status = Mine().models().DeleteVersion("robot", 1);
  EXPECT_EQ(status.code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_THAT(std::string(status.message()), HasSubstr("adaptation arm"));
  ASSERT_TRUE(Mine().adaptations().Delete("arm").ok());
  EXPECT_TRUE(Mine().models().DeleteVersion("robot", 1).ok());
}

TEST_F(ModelsTest, AFileGoesWithTheLastVersionThatHasIt) {
  const auto one = AddVersion("robot", "same");
  AddVersion("other", "same");
  ASSERT_TRUE(Mine().models().DeleteVersion("robot", 1).ok());
  EXPECT_TRUE(BlobExists(one.digest));
  ASSERT_TRUE(Mine().models().DeleteVersion("other", 1).ok());
  EXPECT_FALSE(BlobExists(one.digest));
}

TEST_F(ModelsTest, ADamagedFileIsDataLossThatNamesTheVersion) {
  const auto version = AddVersion("robot");
  FlipBit(version.digest);
  absl::Status status = Mine().models().ReadFile(version).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kDataLoss);
  EXPECT_THAT(std::string(status.message()), HasSubstr("model 'robot' version 1"));
  std::filesystem::remove(store_->blobs().Path(version.digest));
  status = Mine().models().ReadFile(version).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kDataLoss);
  EXPECT_THAT(std::string(status.message()), HasSubstr("model 'robot' version 1"));
}

TEST_F(ModelsTest, WhatIsNotThereIsNotFound) {
  AddVersion("robot");
  TenantStore mine = Mine();
  ModelStore& models = mine.models();
  const auto deleted = AddVersion("robot", "gone");
  ASSERT_TRUE(models.DeleteVersion("robot", 2).ok());
  for (const absl::Status& status :
       {models.Get("x").status(), models.GetLatest("x").status(),
        models.GetVersion("robot", 7).status(), models.GetByAlias("robot", "x").status(),
        models.ListVersions("x", {}).status(), models.SetAlias("robot", "x", 7),
        models.DeleteAlias("robot", "x"), models.DeleteVersion("robot", 7),
        models.ReadFile(deleted).status()}) {
    EXPECT_EQ(status.code(), absl::StatusCode::kNotFound) << status;
  }
}

TEST_F(ModelsTest, BadNamesAreInvalid) {
  AddVersion("robot");
  TenantStore mine = Mine();
  ModelStore& models = mine.models();
  for (const absl::Status& status :
       {models.AddVersion("../x", Blob("w"), "{}").status(), models.Get("").status(),
        models.GetLatest("A").status(), models.GetVersion("a b", 1).status(),
        models.GetByAlias("robot", "3").status(), models.ListVersions("é", {}).status(),
        models.SetAlias("robot", "3", 1)}) {
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << status;
  }
  EXPECT_EQ(models.List({-1, ""}).status().code(), absl::StatusCode::kInvalidArgument);
}

// The same bytes under several models, added and deleted by several threads: the file that they
// share must not vanish under the one that is just being added.
TEST_F(ModelsTest, SharedFilesSurviveConcurrentDeletion) {
  constexpr int kThreads = 4;
  constexpr int kRounds = 25;
  std::vector<std::thread> threads;
  for (int t = 0; t < kThreads; ++t) {
    threads.emplace_back([&, t] {
      const std::string model = absl::StrCat("m", t);
      for (int round = 0; round < kRounds; ++round) {
        const auto version = AddVersion(model, "shared");
        const auto bytes = Mine().models().ReadFile(version);
        EXPECT_TRUE(bytes.ok()) << bytes.status();
        const absl::Status deleted = Mine().models().DeleteVersion(model, version.version);
        EXPECT_TRUE(deleted.ok()) << deleted;
      }
    });
  }
  for (auto& thread : threads) thread.join();
  EXPECT_FALSE(BlobExists(Sha256Hex("shared")));
}

TEST_F(ModelsTest, ConcurrentAdditionsGetDifferentNumbers) {
  std::vector<std::thread> threads;
  for (int t = 0; t < 4; ++t) {
    threads.emplace_back([&] {
      for (int i = 0; i < 10; ++i) AddVersion("robot");
    });
  }
  for (auto& thread : threads) thread.join();
  std::set<int64_t> numbers;
  const auto versions = Mine().models().ListVersions("robot", {}).value();
  for (const auto& version : versions.items) numbers.insert(version.version);
  EXPECT_EQ(numbers.size(), 40);
  EXPECT_EQ(*numbers.rbegin(), 40);
}

}  // namespace
}  // namespace metaekf::store
