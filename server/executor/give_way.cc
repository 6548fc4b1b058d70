#include "server/executor/give_way.h"

#include <sched.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <cstdlib>
#include <filesystem>
#include <mutex>
#include <set>
#include <string>

namespace metaekf::server {
namespace {

/// All threads of a process, as far as they can be told from one another while some end.
template <class Function>
void ForEachThread(pid_t process, const Function& function) {
  std::error_code error;
  std::filesystem::directory_iterator thread("/proc/" + std::to_string(process) + "/task", error);
  for (; !error && thread != std::filesystem::directory_iterator(); thread.increment(error)) {
    function(static_cast<pid_t>(std::atoi(thread->path().filename().c_str())));
  }
}

class Processors {
 public:
  void Keep(int change) {
    const std::lock_guard lock(mutex_);
    const bool before = keepers_ > 0;
    keepers_ += change;
    if (before == (keepers_ > 0)) return;
    ForEachThread(getpid(), [this](pid_t thread) {
      if (sched_getscheduler(thread) == SCHED_BATCH) Assign(thread);
    });
    for (const pid_t process : processes_) AssignAll(process);
  }

  /// The calling thread.
  void Join() {
    const std::lock_guard lock(mutex_);
    if (keepers_ > 0) Assign(0);
  }

  void Add(pid_t process) {
    const std::lock_guard lock(mutex_);
    processes_.insert(process);
    if (keepers_ > 0) AssignAll(process);
  }

  void Remove(pid_t process) {
    const std::lock_guard lock(mutex_);
    processes_.erase(process);
  }

 private:
  // Threads that start meanwhile have the processors of those that start them.
  void AssignAll(pid_t process) const {
    ForEachThread(process, [this](pid_t thread) { Assign(thread); });
  }

  void Assign(pid_t thread) const {
    cpu_set_t processors;
    if (sched_getaffinity(getpid(), sizeof(processors), &processors) != 0) return;  // of the main thread: all there are
    if (keepers_ > 0 && CPU_COUNT(&processors) > 1) {
      int first = 0;
      while (!CPU_ISSET(first, &processors)) ++first;
      CPU_CLR(first, &processors);
    }
    (void)sched_setaffinity(thread, sizeof(processors), &processors);
  }

  std::mutex mutex_;
  int keepers_ = 0;
  std::set<pid_t> processes_;
};

Processors& TheProcessors() {
  static Processors processors;
  return processors;
}

}  // namespace

void GiveWay() {
  // The lowest priority that has a share of its own. SCHED_IDLE sounds like more, but took longer to give way (Linux 6.18).
  constexpr int kLowest = 19;
  (void)setpriority(PRIO_PROCESS, static_cast<id_t>(syscall(SYS_gettid)), kLowest);
  const sched_param none{};
  (void)sched_setscheduler(0, SCHED_BATCH, &none);
  TheProcessors().Join();
}

unsigned UsableProcessors() {
  cpu_set_t processors;
  if (sched_getaffinity(0, sizeof(processors), &processors) != 0) return 1;
  return static_cast<unsigned>(CPU_COUNT(&processors));
}

FreeProcessor::FreeProcessor() { TheProcessors().Keep(1); }
FreeProcessor::~FreeProcessor() { TheProcessors().Keep(-1); }

void AddBatchProcess(pid_t process) { TheProcessors().Add(process); }
void RemoveBatchProcess(pid_t process) { TheProcessors().Remove(process); }

}  // namespace metaekf::server
