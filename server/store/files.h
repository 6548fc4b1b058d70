#pragma once

#include <string>
#include <string_view>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace metaekf::store {

/// The status for an errno value, with message "WHAT: REASON".
///
/// ResourceExhausted when disk or file descriptors are used up, NotFound, FailedPrecondition when
/// permission lacks, Internal otherwise.
absl::Status ErrnoStatus(int error, const std::string& what);

/// Owns a file descriptor.
class UniqueFd {
 public:
  explicit UniqueFd(int fd = -1) : fd_(fd) {}
  UniqueFd(UniqueFd&& other) noexcept : fd_(other.fd_) { other.fd_ = -1; }
  UniqueFd& operator=(UniqueFd&& other) noexcept;
  ~UniqueFd();

  int get() const { return fd_; }
  bool valid() const { return fd_ >= 0; }

 private:
  int fd_;
};

absl::Status WriteAll(int fd, std::string_view bytes);
absl::StatusOr<std::string> ReadFile(const std::string& path);

/// Makes one directory, open to this user only, unless it is there.
absl::Status MakeDirectory(const std::string& path);

/// Names of what is in a directory, in no order.
absl::StatusOr<std::vector<std::string>> ListDirectory(const std::string& path);

/// Makes what happened to the names in a directory survive a power failure.
absl::Status SyncDirectory(const std::string& path);

}  // namespace metaekf::store
