#include "server/store/store.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <atomic>
#include <fstream>
#include <thread>

#include "server/store/schema.h"
#include "tests/server/store/test_store.h"

namespace metaekf::store {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::StartsWith;

absl::Time Epoch() { return absl::UnixEpoch(); }

absl::Status TryOpen(const std::string& directory) {
  return Store::Open(directory, Epoch).status();
}

void ExpectRefused(const absl::Status& status, const std::string& reason) {
  EXPECT_EQ(status.code(), absl::StatusCode::kFailedPrecondition) << status;
  EXPECT_THAT(std::string(status.message()), HasSubstr(reason));
}

TEST(StoreOpenTest, MakesTheDirectoryButNotItsParents) {
  TempDirectory parent;
  EXPECT_TRUE(TryOpen(parent.path() + "/data").ok());
  EXPECT_EQ(TryOpen(parent.path() + "/no/data").code(), absl::StatusCode::kNotFound);
}

TEST(StoreOpenTest, ASecondOpenerIsRefusedUntilTheFirstIsGone) {
  TempDirectory directory;
  auto first = Store::Open(directory.path(), Epoch);
  ASSERT_TRUE(first.ok()) << first.status();
  ExpectRefused(TryOpen(directory.path()), "in use by another server");
  first->reset();
  EXPECT_TRUE(TryOpen(directory.path()).ok());
}

TEST(StoreOpenTest, APlaceThatCannotBeWrittenIsRefused) {
  TempDirectory directory;
  const std::string file = directory.path() + "/file";
  std::ofstream(file) << "x";
  ExpectRefused(TryOpen(file), "cannot write to the data directory " + file);
}

TEST(StoreOpenTest, AnotherFormatIsRefused) {
  TempDirectory directory;
  ASSERT_TRUE(TryOpen(directory.path()).ok());
  {
    auto database = Database::Open(directory.path() + "/metaekf.db").value();
    ASSERT_TRUE(
        database->Write([](Connection& c) { return c.Execute("PRAGMA user_version = 99"); }).ok());
  }
  ExpectRefused(TryOpen(directory.path()), "has format 99, this server knows format 2");
}

TEST(StoreOpenTest, SomeoneElsesDatabaseIsRefused) {
  TempDirectory directory;
  {
    auto database = Database::Open(directory.path() + "/metaekf.db").value();
    ASSERT_TRUE(
        database->Write([](Connection& c) { return c.Execute("CREATE TABLE theirs (x)"); }).ok());
  }
  ExpectRefused(TryOpen(directory.path()), "was not written by this program");
}

TEST(StoreOpenTest, ADamagedDatabaseIsDataLoss) {
  TempDirectory directory;
  std::ofstream(directory.path() + "/metaekf.db") << std::string(8192, 'z');
  EXPECT_EQ(TryOpen(directory.path()).code(), absl::StatusCode::kDataLoss);
}

TEST_F(StoreTest, ALostDatabaseDoesNotCostTheFiles) {
  const auto version = AddVersion("robot");
  const std::string blob = store_->blobs().Path(version.digest);
  store_.reset();
  for (const char* file : {"metaekf.db", "metaekf.db-wal", "metaekf.db-shm"}) {
    std::filesystem::remove(directory_.path() + "/" + file);
  }
  const absl::Status status = TryOpen(directory_.path());
  EXPECT_EQ(status.code(), absl::StatusCode::kDataLoss);
  EXPECT_THAT(std::string(status.message()), HasSubstr("1 stored files but no metaekf.db"));
  EXPECT_TRUE(std::filesystem::exists(blob));
}

TEST_F(StoreTest, OpeningRemovesWhatNothingRefersTo) {
  const auto kept = AddVersion("robot");
  const std::string orphan = store_->blobs().Path(Sha256Hex("orphan"));
  std::ofstream(orphan) << "orphan";
  const std::string half = directory_.path() + "/tmp/half";
  std::ofstream(half) << "half";
  const std::string work = directory_.path() + "/jobs/7";
  std::filesystem::create_directory(work);
  Reopen();
  EXPECT_FALSE(std::filesystem::exists(orphan));
  EXPECT_FALSE(std::filesystem::exists(half));
  EXPECT_FALSE(std::filesystem::exists(work));
  EXPECT_TRUE(BlobExists(kept.digest));
}

TEST_F(StoreTest, TheInventoryCountsEverything) {
  AddVersion("robot", "12345");
  AddVersion("robot", "123");
  AddVersion("plant", "1");
  ASSERT_TRUE(Mine().adaptations().Create({"a", "plant", 1, Blob("12"), "{}", {}}).ok());
  for (int i = 0; i < 6; ++i) ASSERT_TRUE(Mine().jobs().Create({"m", "{}", Blob("d"), {}}).ok());
  for (int i = 0; i < 3; ++i) ASSERT_TRUE(store_->job_queue().Claim("w", absl::Seconds(1)).ok());
  ASSERT_TRUE(Mine().jobs().Cancel(1).ok());
  ASSERT_TRUE(Mine().sessions().Create("models/robot/versions/1", "").ok());
  const auto inventory = store_->TakeInventory("", true);
  ASSERT_TRUE(inventory.ok()) << inventory.status();
  EXPECT_EQ(inventory->format_version, kFormatVersion);
  EXPECT_EQ(inventory->models, 2);
  EXPECT_EQ(inventory->versions, 3);
  EXPECT_EQ(inventory->adaptations, 1);
  EXPECT_EQ(inventory->queued_jobs, 3);
  EXPECT_EQ(inventory->running_jobs, 2);
  EXPECT_EQ(inventory->ended_jobs, 1);
  EXPECT_EQ(inventory->sessions, 1);
  EXPECT_EQ(inventory->stored_bytes, 5 + 3 + 1 + 2);
  EXPECT_GT(inventory->free_disk_bytes, 0);
  EXPECT_THAT(inventory->problems, IsEmpty());
}

TEST_F(StoreTest, TheInventoryNamesDamagedAndMissingFiles) {
  FlipBit(AddVersion("robot", "flipped").digest);
  ASSERT_TRUE(Mine().adaptations().Create({"arm", "robot", 1, Blob("gone"), "{}", {}}).ok());
  std::filesystem::remove(store_->blobs().Path(Sha256Hex("gone")));
  // A glance sees only that a file is gone.
  EXPECT_THAT(store_->TakeInventory("", false)->problems, ElementsAre(StartsWith("adaptation 'arm'")));
  EXPECT_THAT(store_->TakeInventory("", true)->problems,
              ElementsAre(StartsWith("model 'robot' version 1"), StartsWith("adaptation 'arm'")));
}

// Format 1 had no tokens and no audit log, and named directories of jobs by their number.
TEST_F(StoreTest, ADirectoryOfFormatOneIsBroughtUpToDate) {
  const auto version = AddVersion("robot");
  ASSERT_TRUE(Mine().jobs().Create({"m", "{}", Blob("d"), {}}).ok());
  store_.reset();
  {
    auto database = Database::Open(directory_.path() + "/metaekf.db").value();
    ASSERT_TRUE(database
                    ->Write([](Connection& c) -> absl::Status {
                      for (const char* table : {"tokens", "audit"}) {
                        if (absl::Status s = c.Execute(absl::StrCat("DROP TABLE ", table)); !s.ok())
                          return s;
                      }
                      return c.Execute("PRAGMA user_version = 1");
                    })
                    .ok());
  }
  std::filesystem::create_directory(directory_.path() + "/jobs/1");
  std::ofstream(directory_.path() + "/jobs/1/checkpoint") << "kept";
  Reopen();
  EXPECT_EQ(store_->TakeInventory("", true)->format_version, kFormatVersion);
  EXPECT_EQ(Mine().models().GetLatest("robot")->digest, version.digest);
  const auto claimed = store_->job_queue().Claim("w", absl::Seconds(1)).value();
  const std::string work = store_->job_queue().WorkDirectory(claimed->lease).value();
  EXPECT_EQ(ReadFile(work + "/checkpoint").value(), "kept");
  EXPECT_TRUE(store_->Tokens().Create("a", Scope::kRead, absl::InfiniteDuration(), "").ok());
}

TEST_F(StoreTest, TenantsDoNotSeeEachOthersThings) {
  AddVersion("robot", "12345");
  TenantStore other = store_->Of("other");
  EXPECT_EQ(other.models().GetLatest("robot").status().code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(other.models().List({})->items, IsEmpty());
  // The same names again, and the same bytes.
  EXPECT_EQ(other.models().AddVersion("robot", Blob("12345"), "{}")->version, 1);
  ASSERT_TRUE(other.models().DeleteVersion("robot", 1).ok());
  EXPECT_EQ(Mine().models().ReadFile(*Mine().models().GetLatest("robot")).value(), "12345");
  EXPECT_EQ(store_->TakeInventory("other", false)->versions, 0);
  EXPECT_EQ(store_->TakeInventory(kDefaultTenant, false)->versions, 1);
}

TEST_F(StoreTest, WhatIsRemovedWhileAllIsLookedThroughIsNotMissed) {
  AddVersion("staying");
  std::atomic<bool> done = false;
  std::thread changes([&] {
    for (int i = 0; i < 200; ++i) {
      const int64_t version = AddVersion("passing", std::to_string(i)).version;
      EXPECT_TRUE(Mine().models().DeleteVersion("passing", version).ok());
    }
    done = true;
  });
  while (!done) EXPECT_THAT(store_->TakeInventory("", true)->problems, IsEmpty());
  changes.join();
}

TEST_F(StoreTest, AFullDiskStopsNothingForGood) {
  const std::string big(1 << 20, 'x');
  AddVersion("robot");
  {
    FileSizeLimit limit(1000);
    EXPECT_EQ(store_->blobs().Stage(big).status().code(), absl::StatusCode::kResourceExhausted);
    // The row does not fit either.
    EXPECT_EQ(Mine().sessions().Create("t", big).status().code(),
              absl::StatusCode::kResourceExhausted);
    EXPECT_TRUE(Mine().models().GetLatest("robot").ok());
  }
  EXPECT_EQ(AddVersion("robot", big).version, 2);
  EXPECT_THAT(store_->TakeInventory("", true)->problems, IsEmpty());
}

}  // namespace
}  // namespace metaekf::store
