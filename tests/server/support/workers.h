#pragma once

#include <sys/types.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <string>
#include <system_error>
#include <vector>

#include "absl/strings/str_cat.h"

namespace metaekf::server {

/// The training workers of a server's process, each after its parent thread's earlier ones. Other children are none: a sanitizer has one
/// that looks up names.
inline std::vector<pid_t> WorkersOf(pid_t server) {
  std::vector<pid_t> workers;
  std::error_code gone;
  for (const auto& thread : std::filesystem::directory_iterator(absl::StrCat("/proc/", server, "/task"), gone)) {
    std::ifstream children(thread.path() / "children");
    for (pid_t child = 0; children >> child;) {
      std::ifstream command(absl::StrCat("/proc/", child, "/cmdline"));
      std::string program, subcommand;
      if (std::getline(command, program, '\0') && std::getline(command, subcommand, '\0') && subcommand == "worker") workers.push_back(child);
    }
  }
  return workers;
}

/// The one worker of a server; 0 if there is none.
inline pid_t WorkerOf(pid_t server) {
  const std::vector<pid_t> workers = WorkersOf(server);
  return workers.empty() ? 0 : workers.front();
}

}  // namespace metaekf::server
