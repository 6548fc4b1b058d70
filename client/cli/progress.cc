#include "client/cli/progress.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"

namespace metaekf::cli {
namespace {

constexpr int kBarWidth = 30;
constexpr std::chrono::milliseconds kRedraw(100);
constexpr std::chrono::seconds kPlainLine(10);

}  // namespace

std::string FormatDuration(double seconds) {
  const int64_t total = std::llround(seconds);
  if (total < 60) return absl::StrCat(total, " s");
  if (total < 3600) return absl::StrCat(total / 60, " min ", total % 60, " s");
  return absl::StrCat(total / 3600, " h ", total % 3600 / 60, " min");
}

Progress::Progress(Console& console, std::string label)
    : console_(console), label_(std::move(label)) {}

Progress::~Progress() {
  if (drawn_) console_.err << "\r\x1b[K" << std::flush;
}

void Progress::Update(uint64_t done, uint64_t total, std::optional<double> time_left_s,
                      const std::string& text) {
  const Clock::time_point now = Clock::now();
  const bool other_work = pace_from_ && (pace_from_->total != total || done < last_done_);
  last_done_ = done;
  if (!pace_from_ || other_work) pace_from_ = {now, done, total};
  const bool at_once = other_work || (console_.err_is_terminal && !drawn_);
  if (!at_once && now - last_ < (console_.err_is_terminal ? Clock::duration(kRedraw)
                                                        : Clock::duration(kPlainLine))) {
    return;
  }
  last_ = now;
  const double share =
      total > 0 ? std::min(1.0, static_cast<double>(done) / static_cast<double>(total)) : 0;
  if (!time_left_s && done > pace_from_->done && total >= done) {
    const double elapsed_s = std::chrono::duration<double>(now - pace_from_->at).count();
    time_left_s = elapsed_s * static_cast<double>(total - done) / static_cast<double>(done - pace_from_->done);
  }
  std::string line = absl::StrCat(done, "/", total);
  if (time_left_s) absl::StrAppend(&line, ", ", FormatDuration(*time_left_s), " left");
  if (!text.empty()) absl::StrAppend(&line, ", ", text);
  if (console_.err_is_terminal) {
    const int filled = static_cast<int>(std::lround(kBarWidth * share));
    console_.err << "\r\x1b[K" << label_ << " [" << std::string(filled, '#')
                 << std::string(kBarWidth - filled, '.') << "] " << line << std::flush;
    drawn_ = true;
  } else {
    console_.err << label_ << ": " << line << std::endl;
  }
}

}  // namespace metaekf::cli
