#pragma once

#include <signal.h>
#include <sys/wait.h>

#include <optional>
#include <string>

#include "server/training/worker_process.h"

namespace metaekf::server {

/// A metaekfd of its own process on a port that it picks, to be killed.
class ServerProcess {
 public:
  /// Returns once it listens, or with an empty address() if it ended before.
  explicit ServerProcess(const std::string& data_directory, const std::string& config = "")
      : process_(Start(data_directory, config)) {
    const std::string prefix = "listening on ";
    const auto line = process_.ReadLine(absl::Seconds(30), /*wake_fd=*/-1);
    if (line && line->rfind(prefix, 0) == 0) address_ = line->substr(prefix.size());
  }

  const std::string& address() const { return address_; }

  WorkerProcess::Exit End(int signal) {
    process_.Signal(signal);
    return process_.Wait();
  }

 private:
  static WorkerProcess Start(const std::string& data_directory, const std::string& config) {
    std::vector<std::string> arguments = {"--data-dir", data_directory, "--listen", "127.0.0.1:0"};
    if (!config.empty()) arguments.insert(arguments.end(), {"--config", config});
    return WorkerProcess::Start(METAEKFD_BINARY, arguments).value();
  }

  WorkerProcess process_;
  std::string address_;
};

}  // namespace metaekf::server
