#pragma once

#include <signal.h>

#include <string>
#include <vector>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "absl/time/time.h"
#include "server/training/worker_process.h"

namespace metaekf::server {

constexpr size_t kNeighbourRound = 250;  // answers

/// The process of neighbour.cc, and what it tells.
class Neighbour {
 public:
  Neighbour(const std::string& binary, const std::string& address, double reconnect_for_s)
      : process_(WorkerProcess::Start(binary, {address, absl::StrCat(reconnect_for_s)}).value()) {}

  /// Waits until it has had so many answers more. False if it has ended.
  bool Await(size_t answers) {
    for (size_t until = latencies_ms_.size() + answers; latencies_ms_.size() < until;) {
      if (!ReadRound(absl::Seconds(60))) return false;
    }
    return true;
  }

  /// Ends it. Its status; 0 if it was served all the while.
  int End() {
    process_.Signal(SIGTERM);
    while (ReadRound(absl::Seconds(60))) continue;
    return process_.Wait().code;
  }

  /// Of each answer, one after the other.
  const std::vector<double>& latencies_ms() const { return latencies_ms_; }

 private:
  bool ReadRound(absl::Duration timeout) {
    const auto line = process_.ReadLine(timeout, /*wake_fd=*/-1);
    if (!line) return false;
    for (const auto word : absl::StrSplit(*line, ' ', absl::SkipEmpty())) {
      double ms = 0;
      if (absl::SimpleAtod(word, &ms)) latencies_ms_.push_back(ms);
    }
    return true;
  }

  WorkerProcess process_;
  std::vector<double> latencies_ms_;
};

}  // namespace metaekf::server
