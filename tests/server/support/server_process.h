#pragma once

#include <signal.h>
#include <sys/wait.h>

#include <optional>
#include <string>
#include <vector>

#include "server/training/worker_process.h"

namespace metaekf::server {

/// A server of its own process that prints "listening on HOST:PORT"; killed with this object.
class ServerProcess {
 public:
  /// Returns once it listens, or with an empty address() if it ended before.
  ServerProcess(const std::string& binary, const std::vector<std::string>& arguments)
      : process_(WorkerProcess::Start(binary, arguments).value()) {
    const std::string prefix = "listening on ";
    const auto line = process_.ReadLine(absl::Seconds(30), /*wake_fd=*/-1);
    if (line && line->rfind(prefix, 0) == 0) address_ = line->substr(prefix.size());
  }

  /// A metaekfd, on a port that it picks if `listen` names none.
  static ServerProcess Metaekfd(const std::string& data_directory, const std::string& config = "",
                                const std::string& listen = "127.0.0.1:0") {
    std::vector<std::string> arguments = {"--data-dir", data_directory, "--listen", listen};
    if (!config.empty()) arguments.insert(arguments.end(), {"--config", config});
    return ServerProcess(METAEKFD_BINARY, arguments);
  }

  const std::string& address() const { return address_; }
  pid_t pid() const { return process_.pid(); }

  WorkerProcess::Exit End(int signal) {
    process_.Signal(signal);
    return process_.Wait();
  }

 private:
  WorkerProcess process_;
  std::string address_;
};

}  // namespace metaekf::server
