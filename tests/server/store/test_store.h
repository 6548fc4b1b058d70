#pragma once

#include <gtest/gtest.h>
#include <stdlib.h>
#include <sys/resource.h>

#include <csignal>
#include <filesystem>
#include <fstream>
#include <memory>
#include <string>

#include "server/store/store.h"

namespace metaekf::store {

/// A directory that goes with the test.
class TempDirectory {
 public:
  TempDirectory() : path_(::testing::TempDir() + "/metaekf-store-XXXXXX") {
    if (mkdtemp(path_.data()) == nullptr) ADD_FAILURE() << "cannot make " << path_;
  }
  ~TempDirectory() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  const std::string& path() const { return path_; }

 private:
  std::string path_;
};

/// Lets no file grow beyond `bytes` while it lives: what a full disk looks like to a writer.
class FileSizeLimit {
 public:
  explicit FileSizeLimit(rlim_t bytes) {
    previous_handler_ = std::signal(SIGXFSZ, SIG_IGN);
    getrlimit(RLIMIT_FSIZE, &previous_);
    const rlimit limit{bytes, previous_.rlim_max};
    setrlimit(RLIMIT_FSIZE, &limit);
  }
  ~FileSizeLimit() {
    setrlimit(RLIMIT_FSIZE, &previous_);
    std::signal(SIGXFSZ, previous_handler_);
  }

 private:
  rlimit previous_{};
  void (*previous_handler_)(int);
};

/// An open store in a directory of its own, at a time that stands until it is moved.
class StoreTest : public ::testing::Test {
 protected:
  void SetUp() override { Reopen(); }

  void Reopen() {
    store_.reset();
    auto store = Store::Open(directory_.path(), [this] { return now_; });
    ASSERT_TRUE(store.ok()) << store.status();
    store_ = *std::move(store);
  }

  TenantStore Mine() { return store_->Of(kDefaultTenant); }

  StagedBlob Blob(const std::string& bytes) { return store_->blobs().Stage(bytes).value(); }

  ModelVersion AddVersion(const std::string& model, const std::string& bytes = "weights") {
    return Mine().models().AddVersion(model, Blob(bytes), "{}").value();
  }

  bool BlobExists(const std::string& digest) {
    return std::filesystem::exists(store_->blobs().Path(digest));
  }

  /// Changes one bit of a stored file.
  void FlipBit(const std::string& digest) {
    std::fstream file(store_->blobs().Path(digest), std::ios::in | std::ios::out);
    const auto byte = static_cast<char>(file.get() ^ 1);
    file.seekp(0);
    file.put(byte);
  }

  TempDirectory directory_;
  absl::Time now_ = absl::FromUnixSeconds(1'700'000'000);
  std::unique_ptr<Store> store_;
};

}  // namespace metaekf::store
