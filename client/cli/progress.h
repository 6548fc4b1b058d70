#pragma once

#include <chrono>
#include <cstdint>
#include <optional>
#include <string>
#include <utility>

#include "client/cli/console.h"

namespace metaekf::cli {

/// A bar with the time left on a terminal; elsewhere a plain line every ten seconds at most.
class Progress {
 public:
  Progress(Console& console, std::string label);
  /// Clears the bar.
  ~Progress();

  /// @param time_left_s  if somebody knows better than the pace so far.
  /// @param text         shown behind the bar, e.g. "loss 0.12".
  void Update(uint64_t done, uint64_t total, std::optional<double> time_left_s,
              const std::string& text);

 private:
  using Clock = std::chrono::steady_clock;

  Console& console_;
  std::string label_;
  Clock::time_point last_ = Clock::now();
  /// The first report of this work, told from other work by its number of pieces or by less done than before, and what was done by then.
  struct Begin {
    Clock::time_point at;
    uint64_t done, total;
  };
  std::optional<Begin> pace_from_;
  uint64_t last_done_ = 0;
  bool drawn_ = false;
};

/// "42 s", "3 min 5 s", "2 h 10 min".
std::string FormatDuration(double seconds);

}  // namespace metaekf::cli
