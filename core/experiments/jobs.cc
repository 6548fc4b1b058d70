#include "core/experiments/jobs.h"

#include <malloc.h>
#include <time.h>

#include <atomic>
#include <fstream>
#include <limits>
#include <mutex>
#include <vector>

namespace metaekf::experiments {
namespace {

/// A line of /proc/self/status, in MiB.
double StatusMiB(const std::string& name) {
  std::ifstream status("/proc/self/status");
  for (std::string word; status >> word;) {
    double kib = 0;
    if (word == name + ":" && status >> kib) return kib / 1024;
  }
  return std::numeric_limits<double>::quiet_NaN();
}

}  // namespace

PeakMemory::PeakMemory() : held_before_mib_(std::numeric_limits<double>::quiet_NaN()) {
  malloc_trim(0);
  std::ofstream peak("/proc/self/clear_refs");
  if (peak << "5" << std::flush) held_before_mib_ = StatusMiB("VmRSS");  // the peak begins anew
}

double PeakMemory::MiB() const { return StatusMiB("VmHWM") - held_before_mib_; }

double ThreadSeconds() {
  timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

absl::Status RunJobs(size_t count, base::Executor* executor, const std::string& what, const OnProgress& on_progress,
                     const std::function<absl::Status(size_t index)>& job) {
  std::vector<absl::Status> statuses(count);
  std::atomic<bool> stop = false;
  std::mutex telling;
  size_t done = 0;
  bool cancelled = false;
  executor->ParallelFor(count, [&](size_t index, size_t) {
    if (stop) return;
    statuses[index] = job(index);
    const std::lock_guard<std::mutex> lock(telling);
    ++done;
    if (on_progress && !on_progress(done, count, what)) cancelled = true;
    if (cancelled || !statuses[index].ok()) stop = true;
  });
  for (const absl::Status& status : statuses) {
    if (!status.ok()) return status;
  }
  return cancelled ? absl::CancelledError("the study was cancelled") : absl::OkStatus();
}

absl::StatusOr<sim::Fleet> SimulateFleet(const sim::Request& request, base::Executor* executor, const std::string& what, const OnProgress& on_progress) {
  return sim::Simulate(request, *executor, [&](int64_t done) {
    return !on_progress || on_progress(static_cast<size_t>(done), static_cast<size_t>(request.systems), what);
  });
}

}  // namespace metaekf::experiments
