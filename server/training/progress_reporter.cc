#include "server/training/progress_reporter.h"

#include <unistd.h>

#include <algorithm>
#include <chrono>

#include "absl/strings/str_cat.h"
#include "server/convert/json.h"
#include "server/store/files.h"

namespace metaekf::server {
namespace {

constexpr std::chrono::milliseconds kPeriod(500);
constexpr int kPeriodsOfSilence = 10;

}  // namespace

ProgressReporter::ProgressReporter() : thread_([this] { Run(); }) {}

ProgressReporter::~ProgressReporter() {
  {
    std::lock_guard lock(mutex_);
    stopping_ = true;
  }
  changed_.notify_all();
  thread_.join();
}

void ProgressReporter::Progress(const v1::TrainingProgress& progress) {
  std::lock_guard lock(mutex_);
  progress_ = progress;
  has_news_ = true;
}

void ProgressReporter::Checkpointed() {
  std::lock_guard lock(mutex_);
  lines_ += "checkpoint\n";
  has_news_ = true;
}

void ProgressReporter::Error(const std::string& text) {
  std::string line = text;
  std::replace(line.begin(), line.end(), '\n', ' ');
  std::lock_guard lock(mutex_);
  absl::StrAppend(&lines_, "error ", line, "\n");
  has_news_ = true;
}

void ProgressReporter::Run() {
  std::unique_lock lock(mutex_);
  bool last = false;
  for (int silent = 0; !last; ++silent) {
    last = changed_.wait_for(lock, kPeriod, [this] { return stopping_; });
    const std::string lines = TakeLines(silent >= kPeriodsOfSilence);
    if (lines.empty()) continue;
    silent = 0;
    lock.unlock();
    // If nobody reads any more, SIGPIPE ends the worker, as it should.
    store::WriteAll(STDOUT_FILENO, lines).IgnoreError();
    lock.lock();
  }
}

std::string ProgressReporter::TakeLines(bool alive) {
  if (!has_news_ && !alive) return "";
  has_news_ = false;
  // The progress first: a checkpoint counts for the attempt when it is told.
  std::string lines = absl::StrCat("progress ", MessageToJson(progress_), "\n", lines_);
  lines_.clear();
  return lines;
}

}  // namespace metaekf::server
