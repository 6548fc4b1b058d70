#include "server/training/worker_process.h"

#include <fcntl.h>
#include <poll.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <csignal>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "server/executor/give_way.h"

extern char** environ;

namespace metaekf::server {
namespace {

constexpr size_t kMaxLineBytes = 1 << 20;

/// What the child gets: `output` as standard output, no other file of ours, no blocked signals.
class SpawnSettings {
 public:
  explicit SpawnSettings(int output) {
    posix_spawn_file_actions_init(&actions_);
    posix_spawn_file_actions_addopen(&actions_, 0, "/dev/null", O_RDONLY, 0);
    posix_spawn_file_actions_adddup2(&actions_, output, 1);
    posix_spawn_file_actions_addclosefrom_np(&actions_, 3);
    posix_spawnattr_init(&attributes_);
    sigset_t none;
    sigset_t all;
    sigemptyset(&none);
    sigfillset(&all);
    posix_spawnattr_setsigmask(&attributes_, &none);
    posix_spawnattr_setsigdefault(&attributes_, &all);
    posix_spawnattr_setflags(&attributes_, POSIX_SPAWN_SETSIGMASK | POSIX_SPAWN_SETSIGDEF);
  }
  ~SpawnSettings() {
    posix_spawnattr_destroy(&attributes_);
    posix_spawn_file_actions_destroy(&actions_);
  }
  SpawnSettings(const SpawnSettings&) = delete;
  SpawnSettings& operator=(const SpawnSettings&) = delete;

  const posix_spawn_file_actions_t* actions() const { return &actions_; }
  const posix_spawnattr_t* attributes() const { return &attributes_; }

 private:
  posix_spawn_file_actions_t actions_;
  posix_spawnattr_t attributes_;
};

}  // namespace

absl::StatusOr<WorkerProcess> WorkerProcess::Start(const std::string& binary,
                                                   const std::vector<std::string>& arguments) {
  int ends[2];
  if (pipe2(ends, O_CLOEXEC) != 0) return store::ErrnoStatus(errno, "cannot make a pipe");
  store::UniqueFd output(ends[0]);
  const store::UniqueFd input(ends[1]);

  std::vector<std::string> texts = {binary};
  texts.insert(texts.end(), arguments.begin(), arguments.end());
  std::vector<char*> argv;
  for (std::string& text : texts) argv.push_back(text.data());
  argv.push_back(nullptr);

  const SpawnSettings settings(input.get());
  pid_t pid = 0;
  const int error = posix_spawn(&pid, binary.c_str(), settings.actions(), settings.attributes(),
                                argv.data(), environ);
  if (error != 0) return store::ErrnoStatus(error, absl::StrCat("cannot start ", binary));
  AddBatchProcess(pid);
  return WorkerProcess(pid, std::move(output));
}

WorkerProcess::WorkerProcess(WorkerProcess&& other) noexcept
    : pid_(std::exchange(other.pid_, 0)),
      output_(std::move(other.output_)),
      buffer_(std::move(other.buffer_)),
      ended_(other.ended_) {}

WorkerProcess::~WorkerProcess() {
  if (pid_ == 0) return;
  Signal(SIGKILL);
  Wait();
}

std::optional<std::string> WorkerProcess::ReadLine(absl::Duration timeout, int wake_fd) {
  const absl::Time deadline = absl::Now() + timeout;
  while (true) {
    if (const size_t end = buffer_.find('\n'); end != std::string::npos) {
      std::string line = buffer_.substr(0, end);
      buffer_.erase(0, end + 1);
      return line;
    }
    pollfd files[] = {{output_.get(), POLLIN, 0}, {wake_fd, POLLIN, 0}};
    const absl::Duration left = std::max(deadline - absl::Now(), absl::ZeroDuration());
    const int ready = poll(files, 2, static_cast<int>(absl::ToInt64Milliseconds(left)) + 1);
    if (ready < 0 && errno == EINTR) continue;
    if (files[0].revents == 0) return std::nullopt;
    char bytes[4096];
    const ssize_t count = read(output_.get(), bytes, sizeof(bytes));
    if (count < 0 && errno == EINTR) continue;
    ended_ = count <= 0 || buffer_.size() > kMaxLineBytes;
    if (ended_) return std::nullopt;
    buffer_.append(bytes, static_cast<size_t>(count));
  }
}

void WorkerProcess::Signal(int signal) { kill(pid_, signal); }

WorkerProcess::Exit WorkerProcess::Wait() {
  siginfo_t ended;
  while (waitid(P_PID, static_cast<id_t>(pid_), &ended, WEXITED | WNOWAIT) < 0 && errno == EINTR) {
  }
  RemoveBatchProcess(pid_);  // before its number may be another's
  int status = 0;
  waitpid(pid_, &status, 0);
  pid_ = 0;
  if (WIFSIGNALED(status)) return {0, WTERMSIG(status)};
  return {WEXITSTATUS(status), 0};
}

}  // namespace metaekf::server
