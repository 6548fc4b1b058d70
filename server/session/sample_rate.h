#pragma once

#include <chrono>
#include <map>
#include <memory>
#include <mutex>
#include <string>

#include "server/store/quota.h"

namespace metaekf::server {

/// How many samples the streams of one tenant have had lately. Safe to call concurrently.
class SampleRate {
 public:
  using Time = std::chrono::steady_clock::time_point;

  /// @param samples_per_s  positive; what is not used can be used up to a second later.
  explicit SampleRate(double samples_per_s) : samples_per_s_(samples_per_s) {}

  /// Whether streams may go on.
  bool IsReady(Time now) const;
  /// Counts samples that were taken.
  void Count(int64_t samples, Time now);

 private:
  const double samples_per_s_;
  mutable std::mutex mutex_;
  Time paid_until_{};  // at this rate the samples so far take until then
};

/// The rates of tenants that have a limit. Safe to call concurrently.
class SampleRates {
 public:
  /// @param quotas  outlive this.
  explicit SampleRates(const store::Quotas& quotas) : quotas_(quotas) {}

  /// Null where there is no limit; lives as long as this.
  SampleRate* Of(const std::string& tenant);

 private:
  const store::Quotas& quotas_;
  std::mutex mutex_;
  std::map<std::string, std::unique_ptr<SampleRate>> rates_;
};

}  // namespace metaekf::server
