#include "core/data/even_time.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"

namespace metaekf::data {
namespace {

constexpr double kEpsilon = std::numeric_limits<double>::epsilon();

/// The number between `low` and `high` with the fewest significant digits near their middle.
double Simplest(double low, double high) {
  const double middle = low + (high - low) / 2;
  char text[40];
  for (int digits = 1; digits <= 17; ++digits) {
    std::snprintf(text, sizeof(text), "%.*g", digits, middle);
    const double candidate = std::strtod(text, nullptr);
    if (candidate >= low && candidate <= high) return candidate;
  }
  return middle;
}

}  // namespace

double HalfLastDigit(std::string_view text) {
  const size_t mark = std::min(text.find_first_of("eE"), text.size());
  const size_t point = text.substr(0, mark).find('.');
  double exponent = 0;
  if (mark < text.size()) exponent = base::ParseDouble(text.substr(mark + 1)).value_or(0);
  if (point != std::string_view::npos) exponent -= static_cast<double>(mark - point - 1);
  return 0.5 * std::pow(10.0, exponent);
}

absl::Status EvenTime::Add(std::string_view text, double time_s) {
  const double tolerance_s = HalfLastDigit(text);
  if (count_ == 0) {
    start_s_ = last_s_ = time_s;
    start_tolerance_s_ = time_s == 0 ? 0 : tolerance_s;
    ++count_;
    return absl::OkStatus();
  }
  const double step_s = time_s - last_s_;
  if (step_s <= 0) {
    return absl::InvalidArgumentError(absl::StrCat("time ", base::FormatExact(time_s),
                                                   " s does not come after ",
                                                   base::FormatExact(last_s_), " s"));
  }
  if (count_ == 1) first_step_s_ = step_s;
  // A start printed "5" before "5.01" has lost its zeros, not its precision.
  start_tolerance_s_ = std::min(start_tolerance_s_, tolerance_s);
  const double elapsed_s = time_s - start_s_;
  const double slack_s = tolerance_s + start_tolerance_s_ +
                         4 * kEpsilon * std::max(std::abs(time_s), std::abs(start_s_));
  const double steps = static_cast<double>(count_);
  low_s_ = std::max(low_s_, (elapsed_s - slack_s) / steps);
  high_s_ = std::min(high_s_, (elapsed_s + slack_s) / steps);
  const double mean_s = elapsed_s / steps;
  if (low_s_ > high_s_ || step_s > (1.5 - 1e-9) * mean_s) {
    const double expected_s = count_ == 1 ? first_step_s_ : (last_s_ - start_s_) / (steps - 1);
    return absl::InvalidArgumentError(absl::StrCat(
        "uneven time: ", base::FormatShort(step_s, 6), " s after the last row, where ",
        base::FormatShort(expected_s, 6),
        " s was expected; resample the data, or leave lost samples in as rows of nan"));
  }
  last_s_ = time_s;
  ++count_;
  return absl::OkStatus();
}

double EvenTime::PeriodS() const {
  if (count_ < 2) return 0;
  double first_s = first_step_s_;
  if (start_s_ != 0) {
    // The difference of two rounded times: take back the rounding.
    const double rounding_s = 4 * kEpsilon * (std::abs(start_s_) + first_step_s_);
    first_s = Simplest(first_step_s_ - rounding_s, first_step_s_ + rounding_s);
  }
  if (first_s >= low_s_ && first_s <= high_s_) return first_s;
  const double whole = std::round(2 / (low_s_ + high_s_));
  if (whole >= 1 && 1 / whole >= low_s_ && 1 / whole <= high_s_) return 1 / whole;
  return Simplest(low_s_, high_s_);
}

}  // namespace metaekf::data
