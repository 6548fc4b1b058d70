#pragma once

#include <functional>
#include <string>

#include "absl/status/status.h"
#include "core/experiments/experiment.h"
#include "core/sim/simulate.h"

namespace metaekf::experiments {

/// Seconds of the calling thread's processor since some moment: what a piece of work costs, whatever runs beside it.
double ThreadSeconds();

/// Memory that the process comes to hold beyond what it holds when this is made: of work that nothing runs beside.
class PeakMemory {
 public:
  PeakMemory();
  double MiB() const;  ///< so far; NaN where the system does not tell

 private:
  double held_before_mib_;
};

/// Runs job(0) … job(count − 1), each in one thread and as many at a time as the executor has.
///
/// @param on_progress  told after each of them, in one thread at a time. May be empty.
/// @return the error of the first job, by index, that has one; Cancelled if on_progress said so. Jobs that have not begun
/// by then are left out.
absl::Status RunJobs(size_t count, base::Executor* executor, const std::string& what, const OnProgress& on_progress,
                     const std::function<absl::Status(size_t index)>& job);

/// sim::Simulate that tells how far it is. Errors: those, and Cancelled if on_progress said so.
absl::StatusOr<sim::Fleet> SimulateFleet(const sim::Request& request, base::Executor* executor, const std::string& what, const OnProgress& on_progress);

}  // namespace metaekf::experiments
