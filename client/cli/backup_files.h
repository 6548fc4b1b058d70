#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "metaekf/client.h"

/// Backups as they stand on a disk: a data directory, and manifest.json with the digest of each file.
namespace metaekf::cli {

class BackupOutput;

/// What a backup says of itself.
struct Manifest {
  client::BackupInfo info;
  std::vector<client::BackupFile> files;
};

/// Writes a backup as it comes. Until Finish it stands as DIRECTORY.partial, which a later one begins anew.
class BackupWriter final : public client::BackupSink {
 public:
  /// @param on_bytes  hears how many of how many have been written.
  /// Errors: AlreadyExists if `directory` is there; those of the file system.
  static absl::StatusOr<std::unique_ptr<BackupWriter>> Create(
      const std::string& directory, std::function<void(uint64_t done, uint64_t total)> on_bytes);
  ~BackupWriter() override;

  client::Status Begin(const client::BackupInfo& info) override;
  client::Status File(const client::BackupFile& file) override;
  client::Status Bytes(const std::string& bytes) override;

  /// After all of it has come. Brings it to disk and gives it its name.
  absl::StatusOr<Manifest> Finish();
  /// Files that came damaged or not at all, and are not in the backup.
  const std::vector<std::string>& damaged() const { return damaged_; }

 private:
  explicit BackupWriter(std::string directory);
  absl::Status EndFile();

  const std::string directory_, partial_;
  std::function<void(uint64_t, uint64_t)> on_bytes_;
  Manifest manifest_;
  std::optional<client::BackupFile> file_;  // that is being written
  std::unique_ptr<BackupOutput> output_;
  uint64_t written_ = 0;
  std::vector<std::string> damaged_;
};

/// Reads every file of a backup and compares it with the manifest.
/// Errors: NotFound if there is no manifest, InvalidArgument if it is none; DataLoss naming what is damaged or gone.
absl::StatusOr<Manifest> VerifyBackup(const std::string& directory);

/// Verifies a backup and makes a data directory of it. Errors: those of VerifyBackup; AlreadyExists if there is anything in
/// `data_directory`; those of the file system. Nothing stands there then.
absl::StatusOr<Manifest> RestoreBackup(const std::string& backup, const std::string& data_directory);

}  // namespace metaekf::cli
