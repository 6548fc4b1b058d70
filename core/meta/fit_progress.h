#pragma once

#include <functional>
#include <mutex>
#include <utility>

namespace metaekf::meta {

/// Called with (step, Φ) after every step of a fit; false stops it.
using OnFitStep = std::function<bool(int step, double cost)>;

/// Passes on what fits in several threads tell, one at a time. Once one of them has been stopped, all are.
class FitProgress {
 public:
  explicit FitProgress(OnFitStep on_step) : on_step_(std::move(on_step)) {}

  /// @return whether to go on.
  bool Tell(int step, double cost) {
    const std::lock_guard lock(mutex_);
    if (!stopped_ && on_step_ && !on_step_(step, cost)) stopped_ = true;
    return !stopped_;
  }

  bool stopped() const {
    const std::lock_guard lock(mutex_);
    return stopped_;
  }

 private:
  const OnFitStep on_step_;
  mutable std::mutex mutex_;
  bool stopped_ = false;
};

}  // namespace metaekf::meta
