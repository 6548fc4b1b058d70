#include "server/store/audit.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/server/store/test_store.h"

namespace metaekf::store {
namespace {

using ::testing::ElementsAre;

class AuditTest : public StoreTest {
 protected:
  /// The entries as "tenant identity action resource", oldest first.
  std::vector<std::string> Entries(const std::string& tenant = "") {
    std::vector<std::string> entries;
    const Page<AuditEntry> page = store_->audit().List({1000, ""}, tenant).value();
    for (const AuditEntry& entry : page.items) {
      entries.insert(entries.begin(), absl::StrCat(entry.tenant, " ", entry.identity, " ",
                                                   entry.action, " ", entry.resource));
    }
    return entries;
  }
};

TEST_F(AuditTest, TellsWhoChangedWhat) {
  TenantStore mine = store_->Of("plant", "token t1");
  mine.models().AddVersion("robot", Blob("w"), "{}").value();
  ASSERT_TRUE(mine.models().SetAlias("robot", "live", 1).ok());
  mine.adaptations().Create({"arm", "robot", 1, Blob("a"), "{}", {}}).value();
  const NewSession session = mine.sessions().Create("adaptations/arm", "").value();
  mine.sessions().Claim(1, session.token).value();
  mine.jobs().Create({"robot", "{}", Blob("d"), {}}).value();
  store_->Of("other", "token t2").models().AddVersion("pump", Blob("p"), "{}").value();
  Reopen();
  EXPECT_THAT(Entries("plant"),
              ElementsAre("plant token t1 CreateModelVersion models/robot/versions/1",
                          "plant token t1 SetModelAlias models/robot/aliases/live",
                          "plant token t1 CreateAdaptation adaptations/arm",
                          "plant token t1 OpenSession sessions/1",
                          "plant token t1 ResumeSession sessions/1",
                          "plant token t1 CreateTrainingJob jobs/1"));
  EXPECT_EQ(Entries().size(), 7);
  // Which version served whom.
  EXPECT_EQ(store_->audit().List({1000, ""}, "plant")->items[1].detail, "adaptations/arm");
}

TEST_F(AuditTest, WhatDidNotHappenIsNotTold) {
  TenantStore mine = store_->Of("plant", "token t1");
  EXPECT_FALSE(mine.models().SetAlias("robot", "live", 1).ok());
  EXPECT_FALSE(mine.adaptations().Delete("arm").ok());
  EXPECT_FALSE(mine.sessions().Claim(1, "guess").ok());
  EXPECT_FALSE(mine.jobs().Cancel(1).ok());
  EXPECT_THAT(Entries(), ElementsAre());
}

TEST_F(AuditTest, WhatAJobPublishesIsTheServersDoing) {
  Mine().jobs().Create({"robot", "{}", Blob("d"), {}}).value();
  const JobLease lease = store_->job_queue().Claim("w", absl::Seconds(1)).value()->lease;
  store_->job_queue().Publish(lease, Blob("w"), "{}").value();
  EXPECT_EQ(Entries().back(), "default server CreateModelVersion models/robot/versions/1");
}

TEST_F(AuditTest, EntriesCanNeitherBeChangedNorRemoved) {
  AddVersion("robot");
  store_.reset();
  auto database = Database::Open(directory_.path() + "/metaekf.db").value();
  for (const char* attempt : {"DELETE FROM audit", "UPDATE audit SET identity = 'someone else'"}) {
    EXPECT_FALSE(database->Write([&](Connection& c) { return c.Execute(attempt); }).ok())
        << attempt;
  }
  database.reset();
  Reopen();
  EXPECT_EQ(Entries().size(), 1);
}

TEST_F(AuditTest, PagesGoFromTheNewestToTheOldest) {
  for (int i = 0; i < 5; ++i) AddVersion("robot");
  const auto first = store_->audit().List({3, ""}, "").value();
  ASSERT_EQ(first.items.size(), 3);
  EXPECT_EQ(first.items[0].number, 5);
  const auto second = store_->audit().List({3, first.next_page_token}, "").value();
  EXPECT_EQ(second.items.back().number, 1);
  EXPECT_EQ(second.next_page_token, "");
  EXPECT_FALSE(store_->audit().List({3, first.next_page_token}, "plant").ok()) << "of another list";
}

}  // namespace
}  // namespace metaekf::store
