#pragma once

#include <poll.h>
#include <sys/inotify.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <string>
#include <system_error>

#include "absl/time/time.h"

namespace metaekf::server {

/// What happens to the files of a directory and of the directories that it has by now, whoever does it: files made, written,
/// closed, moved, deleted. Changes alike that follow each other unread may be told as one.
class DirectoryChanges {
 public:
  explicit DirectoryChanges(const std::string& directory) : fd_(inotify_init1(IN_NONBLOCK | IN_CLOEXEC)) {
    Watch(directory);
    for (const auto& entry : std::filesystem::recursive_directory_iterator(directory)) {
      if (entry.is_directory()) Watch(entry.path());
    }
  }
  ~DirectoryChanges() { close(fd_); }
  DirectoryChanges(const DirectoryChanges&) = delete;
  DirectoryChanges& operator=(const DirectoryChanges&) = delete;

  /// Returns once `count` more have been seen; false if they do not come within `timeout` of each other.
  bool Wait(size_t count, absl::Duration timeout = absl::Seconds(30)) {
    while (uncounted_ < count) {
      pollfd ready{.fd = fd_, .events = POLLIN, .revents = 0};
      const int answered = poll(&ready, 1, static_cast<int>(absl::ToInt64Milliseconds(timeout)));
      if (answered < 0 && errno == EINTR) continue;
      if (answered <= 0) return false;
      Read();
    }
    uncounted_ -= count;
    return true;
  }

 private:
  void Watch(const std::string& directory) {
    constexpr uint32_t kChanges = IN_CREATE | IN_MODIFY | IN_CLOSE_WRITE | IN_MOVED_TO | IN_DELETE;
    if (inotify_add_watch(fd_, directory.c_str(), kChanges) >= 0) return;
    throw std::system_error(errno, std::generic_category(), "cannot watch " + directory);
  }

  void Read() {
    alignas(inotify_event) std::array<char, 16384> buffer;
    for (ssize_t size; (size = read(fd_, buffer.data(), buffer.size())) > 0;) {
      for (const char* at = buffer.data(); at < buffer.data() + size; ++uncounted_) {
        at += sizeof(inotify_event) + reinterpret_cast<const inotify_event*>(at)->len;
      }
    }
  }

  int fd_;
  size_t uncounted_ = 0;
};

}  // namespace metaekf::server
