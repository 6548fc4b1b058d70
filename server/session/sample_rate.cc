#include "server/session/sample_rate.h"

#include <algorithm>
#include <cmath>

namespace metaekf::server {

using std::chrono::duration;
using std::chrono::steady_clock;

bool SampleRate::IsReady(Time now) const {
  std::lock_guard lock(mutex_);
  return paid_until_ <= now;
}

void SampleRate::Count(int64_t samples, Time now) {
  constexpr std::chrono::seconds kSaved(1);
  const duration<double> take(static_cast<double>(samples) / samples_per_s_);
  std::lock_guard lock(mutex_);
  paid_until_ = std::max(paid_until_, now - kSaved) + std::chrono::duration_cast<steady_clock::duration>(take);
}

SampleRate* SampleRates::Of(const std::string& tenant) {
  const double limit = quotas_.Of(tenant).samples_per_s;
  if (std::isinf(limit)) return nullptr;
  std::lock_guard lock(mutex_);
  std::unique_ptr<SampleRate>& rate = rates_[tenant];
  if (rate == nullptr) rate = std::make_unique<SampleRate>(limit);
  return rate.get();
}

}  // namespace metaekf::server
