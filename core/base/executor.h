#pragma once

#include <cstddef>
#include <functional>
#include <memory>

namespace metaekf::base {

/// Runs independent pieces of work; the only way in which core uses threads.
///
/// Results must not depend on the executor: each piece writes to its own place, and what is summed
/// over pieces is summed by the caller in index order.
class Executor {
 public:
  virtual ~Executor() = default;

  /// Calls work(0) … work(count − 1), in any order and possibly at the same time; returns when all are done.
  /// `slot` is below concurrency() and never used by two calls at once: an index into per-thread scratch.
  virtual void ParallelFor(size_t count,
                           const std::function<void(size_t index, size_t slot)>& work) = 0;
  virtual size_t concurrency() const = 0;
};

/// Runs everything in the calling thread. One for all: it has no state.
Executor* CallingThread();

/// Runs on `threads` threads, the caller's among them; threads must be positive.
std::unique_ptr<Executor> MakeThreadExecutor(size_t threads);

}  // namespace metaekf::base
