#pragma once

#include <atomic>
#include <condition_variable>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "server/options.h"
#include "server/store/store.h"
#include "server/training/job_feed.h"
#include "server/training/worker_process.h"

namespace metaekf::server {

/// Takes training jobs from the store and runs each in a worker process: as many at a time as the
/// options say, one thread looking after each.
///
/// A worker that dies loses its attempt, and the job goes on from its checkpoint; one that has not
/// said anything for as long as a lease lasts is killed. All changes of a job go through its lease,
/// so what a cancelled or late attempt does has no effect.
class TrainingScheduler {
 public:
  TrainingScheduler(store::Store& store, JobFeed& feed, const ServerOptions& options);
  ~TrainingScheduler();

  /// Queues again what an earlier server was running, and begins.
  absl::Status Start();
  /// A job has been queued.
  void Wake();
  /// A job has been cancelled: its worker stops.
  void CheckJobs();
  /// Lets the workers write a checkpoint, gives their jobs back and returns when all have ended,
  /// after the drain timeout at the latest.
  void Stop();

 private:
  /// Looks after one worker at a time.
  class Slot;

  store::Store& store_;
  JobFeed& feed_;
  const ServerOptions& options_;
  std::mutex mutex_;
  std::condition_variable wake_;
  uint64_t queued_ = 0;  // counts Wake, so that none is missed
  std::atomic<bool> stopping_ = false;
  std::vector<std::unique_ptr<Slot>> slots_;
};

}  // namespace metaekf::server
