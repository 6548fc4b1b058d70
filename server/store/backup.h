#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"

namespace metaekf::store {

/// Everything that a store held at one moment, in a directory that goes with this object. What the store does meanwhile
/// changes nothing in it: its files are links.
class Backup {
 public:
  struct File {
    std::string path;  ///< within the backup: metaekf.db, or blobs/DIGEST
    int64_t size_bytes = 0;
    std::string sha256;
  };

  /// @param directory  in which the files stand.
  explicit Backup(std::string directory) : directory_(std::move(directory)) {}
  ~Backup();
  Backup(const Backup&) = delete;

  /// The database first.
  const std::vector<File>& files() const { return files_; }
  std::string PathOf(const File& file) const { return directory_ + "/" + file.path; }

 private:
  friend class Store;
  const std::string directory_;
  std::vector<File> files_;
};

}  // namespace metaekf::store
