#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/store/files.h"
#include "server/store/sha256.h"

namespace metaekf::store {

/// A file that is complete and on disk, but belongs to nothing yet. Dropped, it is removed.
class StagedBlob {
 public:
  StagedBlob(StagedBlob&& other) noexcept;
  StagedBlob& operator=(StagedBlob&& other) = delete;
  ~StagedBlob();

  const std::string& digest() const { return digest_; }  ///< SHA-256, 64 hexadecimal digits
  int64_t size_bytes() const { return size_bytes_; }

 private:
  friend class BlobWriter;
  friend class BlobStore;
  StagedBlob(std::string path, std::string digest, int64_t size_bytes);

  std::string path_;  // empty: published or moved from
  std::string digest_;
  int64_t size_bytes_;
};

/// Writes a blob piece by piece. Dropped before Finish, it leaves nothing behind.
class BlobWriter {
 public:
  BlobWriter(BlobWriter&& other) noexcept = default;
  ~BlobWriter();

  /// Errors: ResourceExhausted when the disk is full.
  absl::Status Append(std::string_view bytes);
  int64_t size_bytes() const { return size_bytes_; }
  /// Brings the file to disk. Call it once, last. Errors: as Append.
  absl::StatusOr<StagedBlob> Finish();

 private:
  friend class BlobStore;
  BlobWriter(UniqueFd file, std::string path) : file_(std::move(file)), path_(std::move(path)) {}

  UniqueFd file_;
  std::string path_;
  Sha256 sha256_;
  int64_t size_bytes_ = 0;
};

/// The bytes of the blob file at `path`. It is named by its digest, against which they are checked;
/// other processes may read it so.
/// Errors: NotFound; DataLoss if the bytes are not those that were written.
absl::StatusOr<std::string> ReadBlob(const std::string& path);

/// Files named by the SHA-256 of their content, in two directories: tmp/ while they are written,
/// blobs/ once a row of the database refers to them.
///
/// Publish and Remove are called in a write transaction only: so no blob vanishes between the check
/// that nothing refers to it and its removal.
class BlobStore {
 public:
  /// Makes the directories and empties tmp/.
  static absl::StatusOr<BlobStore> Open(const std::string& directory);

  absl::StatusOr<BlobWriter> NewBlob() const;
  absl::StatusOr<StagedBlob> Stage(std::string_view bytes) const;
  /// Moves a staged file to its final name, durably. An equal file that stands there is replaced.
  absl::Status Publish(StagedBlob& blob) const;
  void Remove(const std::string& digest) const;

  /// The bytes of a blob. Errors: DataLoss naming `owner` if the file is damaged or gone.
  absl::StatusOr<std::string> Read(const std::string& digest, const std::string& owner) const;
  /// Where a worker process finds the blob. Not for clients.
  std::string Path(const std::string& digest) const;
  absl::StatusOr<std::vector<std::string>> List() const;

 private:
  explicit BlobStore(const std::string& directory);

  std::string blobs_;
  std::string tmp_;
};

}  // namespace metaekf::store
