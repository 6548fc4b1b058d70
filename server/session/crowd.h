#pragma once

#include <chrono>
#include <cstdint>
#include <mutex>

namespace metaekf::server {

/// Tells when batches of many streams come one upon the other.
///
/// gRPC's threads take events in the order in which they came. A thousand streams with a batch each have whoever comes next wait for a
/// thousand batches, unless these are worked on elsewhere.
/// Safe to call concurrently.
class Crowd {
 public:
  /// Notes that a batch of a stream is taken up.
  /// @param rush  kept for the stream; 0 at first. @return whether more than a few streams have had one taken up without a pause between.
  bool Joins(std::chrono::steady_clock::time_point now, uint64_t* rush) {
    constexpr int kFew = 8;
    constexpr std::chrono::milliseconds kPause(1);
    std::lock_guard lock(mutex_);
    if (now - last_ > kPause) ++rush_, streams_ = 0;
    last_ = now;
    if (*rush != rush_) ++streams_;
    *rush = rush_;
    return streams_ > kFew;
  }

 private:
  std::mutex mutex_;
  std::chrono::steady_clock::time_point last_;
  uint64_t rush_ = 0;  // number of the present one; a pause ends it
  int streams_ = 0;    // seen in it
};

}  // namespace metaekf::server
