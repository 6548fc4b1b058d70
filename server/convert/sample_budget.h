#pragma once

#include <atomic>
#include <cstdint>

#include "absl/status/status.h"

namespace metaekf::server {

/// Bounds what calls hold of recordings, and of what they compute from them, together.
class SampleBudget {
 public:
  explicit SampleBudget(int64_t bytes) : bytes_(bytes) {}
  SampleBudget(const SampleBudget&) = delete;
  SampleBudget& operator=(const SampleBudget&) = delete;

  /// What one call holds; given back with it.
  class Share {
   public:
    explicit Share(SampleBudget& budget) : budget_(budget) {}
    ~Share() { ShrinkTo(0); }
    Share(const Share&) = delete;
    Share& operator=(const Share&) = delete;

    /// Errors: ResourceExhausted if the budget has no room for `bytes` more, with a retry delay if only others hold too much.
    absl::Status Grow(int64_t bytes);
    void ShrinkTo(int64_t bytes);

   private:
    SampleBudget& budget_;
    int64_t held_ = 0;
  };

 private:
  const int64_t bytes_;
  std::atomic<int64_t> used_ = 0;
};

}  // namespace metaekf::server
