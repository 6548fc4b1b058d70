#pragma once

#include <condition_variable>
#include <mutex>
#include <string>
#include <thread>

#include "metaekf/v1/training.pb.h"

namespace metaekf::server {

/// Writes a worker's lines to standard output, from a thread of its own: at most every half second,
/// at least every five, so that silence means that the worker hangs.
class ProgressReporter {
 public:
  ProgressReporter();
  /// Writes what has not been written yet.
  ~ProgressReporter();

  void Progress(const v1::TrainingProgress& progress);
  void Checkpointed();
  void Error(const std::string& text);

 private:
  void Run();
  std::string TakeLines(bool alive);  // with mutex_ held

  std::mutex mutex_;
  std::condition_variable changed_;
  v1::TrainingProgress progress_;
  bool has_news_ = false;
  bool stopping_ = false;
  std::string lines_;  // to write beside the progress
  std::thread thread_;
};

}  // namespace metaekf::server
