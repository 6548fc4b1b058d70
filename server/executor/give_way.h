#pragma once

#include <sys/types.h>

namespace metaekf::server {

/// Has the calling thread, and those that it starts from then on, work in the time that others leave: for adaptations and trainings, which
/// last, beside estimates, which someone waits for. Where the system refuses, it works all the same, only less politely.
void GiveWay();

/// How many processors the calling thread may use. (std::thread::hardware_concurrency() counts those that it may not, too.)
unsigned UsableProcessors();

/// While one lives, threads of this process that GiveWay, and processes that were added, leave one of the processors free, if they may
/// use several: priority alone has whoever wakes up wait for milliseconds.
class FreeProcessor {
 public:
  FreeProcessor();
  ~FreeProcessor();
  FreeProcessor(const FreeProcessor&) = delete;
  FreeProcessor& operator=(const FreeProcessor&) = delete;
};

/// Has a process leave it, too, from its start on; to be removed when it has ended.
void AddBatchProcess(pid_t process);
void RemoveBatchProcess(pid_t process);

}  // namespace metaekf::server
