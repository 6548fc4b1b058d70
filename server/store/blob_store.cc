#include "server/store/blob_store.h"

#include <fcntl.h>
#include <stdlib.h>
#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <filesystem>
#include <utility>

#include "core/base/status.h"

namespace metaekf::store {
namespace {

constexpr size_t kDigestLength = 64;

}  // namespace

StagedBlob::StagedBlob(std::string path, std::string digest, int64_t size_bytes)
    : path_(std::move(path)), digest_(std::move(digest)), size_bytes_(size_bytes) {}

StagedBlob::StagedBlob(StagedBlob&& other) noexcept
    : path_(std::exchange(other.path_, "")),
      digest_(other.digest_),
      size_bytes_(other.size_bytes_) {}

StagedBlob::~StagedBlob() {
  if (!path_.empty()) unlink(path_.c_str());
}

BlobWriter::~BlobWriter() {
  if (file_.valid()) unlink(path_.c_str());
}

absl::Status BlobWriter::Append(std::string_view bytes) {
  METAEKF_RETURN_IF_ERROR(WriteAll(file_.get(), bytes));
  sha256_.Update(bytes);
  size_bytes_ += static_cast<int64_t>(bytes.size());
  return absl::OkStatus();
}

absl::StatusOr<StagedBlob> BlobWriter::Finish() {
  if (fsync(file_.get()) != 0) return ErrnoStatus(errno, "cannot write");
  file_ = UniqueFd();
  return StagedBlob(path_, sha256_.HexDigest(), size_bytes_);
}

absl::StatusOr<std::string> ReadBlob(const std::string& path) {
  METAEKF_ASSIGN_OR_RETURN(std::string bytes, ReadFile(path));
  if (Sha256Hex(bytes) != std::filesystem::path(path).filename()) {
    return absl::DataLossError("the stored file is damaged: its content has changed");
  }
  return bytes;
}

BlobStore::BlobStore(const std::string& directory)
    : blobs_(directory + "/blobs"), tmp_(directory + "/tmp") {}

absl::StatusOr<BlobStore> BlobStore::Open(const std::string& directory) {
  BlobStore store(directory);
  METAEKF_RETURN_IF_ERROR(MakeDirectory(store.blobs_));
  METAEKF_RETURN_IF_ERROR(MakeDirectory(store.tmp_));
  METAEKF_RETURN_IF_ERROR(SyncDirectory(directory));
  METAEKF_ASSIGN_OR_RETURN(const auto left_over, ListDirectory(store.tmp_));
  for (const std::string& name : left_over) {
    std::error_code ignored;  // the next start tries again
    std::filesystem::remove_all(absl::StrCat(store.tmp_, "/", name), ignored);
  }
  return store;
}

absl::StatusOr<BlobWriter> BlobStore::NewBlob() const {
  std::string path = tmp_ + "/XXXXXX";
  UniqueFd file(mkostemp(path.data(), O_CLOEXEC));
  if (!file.valid()) return ErrnoStatus(errno, "cannot make a file in the data directory");
  return BlobWriter(std::move(file), path);
}

absl::StatusOr<StagedBlob> BlobStore::Stage(std::string_view bytes) const {
  METAEKF_ASSIGN_OR_RETURN(BlobWriter writer, NewBlob());
  METAEKF_RETURN_IF_ERROR(writer.Append(bytes));
  return writer.Finish();
}

absl::Status BlobStore::Publish(StagedBlob& blob) const {
  if (rename(blob.path_.c_str(), Path(blob.digest_).c_str()) != 0) {
    return ErrnoStatus(errno, "cannot keep the file");
  }
  blob.path_.clear();
  return SyncDirectory(blobs_);
}

void BlobStore::Remove(const std::string& digest) const { unlink(Path(digest).c_str()); }

absl::StatusOr<std::string> BlobStore::Read(const std::string& digest,
                                            const std::string& owner) const {
  auto bytes = ReadBlob(Path(digest));
  if (bytes.ok()) return bytes;
  if (absl::IsNotFound(bytes.status())) {
    return absl::DataLossError(absl::StrCat(owner, ": the stored file is gone"));
  }
  return base::Annotate(bytes.status(), owner);
}

std::string BlobStore::Path(const std::string& digest) const {
  return absl::StrCat(blobs_, "/", digest);
}

absl::StatusOr<std::vector<std::string>> BlobStore::List() const {
  METAEKF_ASSIGN_OR_RETURN(auto names, ListDirectory(blobs_));
  std::erase_if(names, [](const std::string& name) {
    return name.size() != kDigestLength ||
           name.find_first_not_of("0123456789abcdef") != std::string::npos;
  });
  return names;
}

}  // namespace metaekf::store
