#include "server/store/blob_store.h"

#include <gtest/gtest.h>

#include <fstream>

#include "tests/server/store/test_store.h"

namespace metaekf::store {
namespace {

class BlobStoreTest : public testing::Test {
 protected:
  size_t FilesIn(const std::string& subdirectory) {
    return ListDirectory(directory_.path() + "/" + subdirectory)->size();
  }
  void Write(const std::string& path, const std::string& content) {
    std::ofstream(directory_.path() + "/" + path) << content;
  }

  TempDirectory directory_;
  BlobStore blobs_ = BlobStore::Open(directory_.path()).value();
};

TEST_F(BlobStoreTest, ReadsBackWhatWasPublished) {
  auto writer = blobs_.NewBlob();
  ASSERT_TRUE(writer.ok());
  EXPECT_TRUE(writer->Append("ab").ok());
  EXPECT_TRUE(writer->Append("c").ok());
  auto staged = writer->Finish();
  ASSERT_TRUE(staged.ok());
  EXPECT_EQ(staged->digest(), Sha256Hex("abc"));
  EXPECT_EQ(staged->size_bytes(), 3);
  ASSERT_TRUE(blobs_.Publish(*staged).ok());
  EXPECT_EQ(blobs_.Read(staged->digest(), "x").value(), "abc");
  EXPECT_EQ(ReadBlob(blobs_.Path(staged->digest())).value(), "abc");
  EXPECT_EQ(blobs_.List().value(), std::vector{Sha256Hex("abc")});
}

TEST_F(BlobStoreTest, WhatIsNotPublishedLeavesNothing) {
  {
    auto writer = blobs_.NewBlob();
    ASSERT_TRUE(writer->Append("abc").ok());
    auto staged = blobs_.Stage("def");
    StagedBlob moved = *std::move(staged);
    EXPECT_EQ(FilesIn("tmp"), 2);
  }
  EXPECT_EQ(FilesIn("tmp"), 0);
  EXPECT_EQ(FilesIn("blobs"), 0);
}

TEST_F(BlobStoreTest, OpeningEmptiesTmp) {
  Write("tmp/left-over", "half");
  ASSERT_TRUE(BlobStore::Open(directory_.path()).ok());
  EXPECT_EQ(FilesIn("tmp"), 0);
}

TEST_F(BlobStoreTest, AChangedFileIsDataLoss) {
  auto staged = blobs_.Stage("abc");
  ASSERT_TRUE(blobs_.Publish(*staged).ok());
  for (const char* damaged : {"abd", "ab", "abcd", ""}) {
    Write("blobs/" + staged->digest(), damaged);
    const absl::Status status = blobs_.Read(staged->digest(), "model 'm' version 1").status();
    EXPECT_EQ(status.code(), absl::StatusCode::kDataLoss);
    EXPECT_EQ(status.message(),
              "model 'm' version 1: the stored file is damaged: its content has changed");
  }
}

TEST_F(BlobStoreTest, PublishingAgainHealsADamagedFile) {
  auto first = blobs_.Stage("abc");
  ASSERT_TRUE(blobs_.Publish(*first).ok());
  Write("blobs/" + first->digest(), "abd");
  auto second = blobs_.Stage("abc");
  ASSERT_TRUE(blobs_.Publish(*second).ok());
  EXPECT_EQ(blobs_.Read(first->digest(), "x").value(), "abc");
}

TEST_F(BlobStoreTest, AMissingFileIsDataLossOfItsOwner) {
  const absl::Status status = blobs_.Read(Sha256Hex("abc"), "adaptation 'a'").status();
  EXPECT_EQ(status.code(), absl::StatusCode::kDataLoss);
  EXPECT_EQ(status.message(), "adaptation 'a': the stored file is gone");
  EXPECT_EQ(ReadBlob(blobs_.Path(Sha256Hex("abc"))).status().code(), absl::StatusCode::kNotFound);
}

TEST_F(BlobStoreTest, AFullDiskIsResourceExhaustedAndLeavesNothing) {
  {
    FileSizeLimit limit(1000);
    auto writer = blobs_.NewBlob();
    ASSERT_TRUE(writer.ok());
    EXPECT_TRUE(writer->Append(std::string(900, 'x')).ok());
    const absl::Status status = writer->Append(std::string(900, 'x'));
    EXPECT_EQ(status.code(), absl::StatusCode::kResourceExhausted) << status;
  }
  EXPECT_EQ(FilesIn("tmp"), 0);
}

TEST_F(BlobStoreTest, ListsBlobsOnly) {
  Write("blobs/README", "not ours");
  Write("blobs/" + std::string(64, 'X'), "not ours");
  EXPECT_TRUE(blobs_.List()->empty());
}

}  // namespace
}  // namespace metaekf::store
