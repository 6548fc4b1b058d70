#pragma once

#include <sys/types.h>

#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "server/store/files.h"

namespace metaekf::server {

/// A child process and the lines that it writes to its standard output; its standard error is ours.
/// For one thread; the child asks the kernel to end it when that thread ends. Dropped, it is
/// killed.
class WorkerProcess {
 public:
  static absl::StatusOr<WorkerProcess> Start(const std::string& binary,
                                             const std::vector<std::string>& arguments);
  WorkerProcess(WorkerProcess&& other) noexcept;
  ~WorkerProcess();

  /// The next line. Nothing at the timeout, when `wake_fd` becomes readable, and at the end of the
  /// output, which ended() tells.
  std::optional<std::string> ReadLine(absl::Duration timeout, int wake_fd);
  bool ended() const { return ended_; }

  void Signal(int signal);
  pid_t pid() const { return pid_; }

  struct Exit {
    int code = 0;    ///< if signal is 0
    int signal = 0;  ///< that ended it
  };
  /// Waits for the end of the process. Call it once.
  Exit Wait();

 private:
  WorkerProcess(pid_t pid, store::UniqueFd output) : pid_(pid), output_(std::move(output)) {}

  pid_t pid_;  // 0: waited for or moved from
  store::UniqueFd output_;
  std::string buffer_;
  bool ended_ = false;
};

}  // namespace metaekf::server
