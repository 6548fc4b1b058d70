#pragma once

#include <limits>
#include <string>
#include <string_view>

#include "absl/status/status.h"

namespace metaekf::data {

/// Checks, sample by sample, that printed times are evenly spaced, and finds their period.
///
/// The k-th time must lie on t₀ + k T for one period T to within half its last printed digit (and
/// half that of t₀, unless t₀ is zero; and the rounding of doubles): the periods that fit all times
/// so far are an interval, and it must not become empty. Digits as coarse as the period itself
/// would make that blind to a lost sample, so a step must also stay below 1.5 mean steps.
class EvenTime {
 public:
  /// Takes the next time, as printed and as read. Errors: InvalidArgument, without place, if the
  /// time is not later than the last one or not evenly spaced.
  absl::Status Add(std::string_view text, double time_s);

  double start_s() const { return start_s_; }

  /// The period: of those that fit, the first difference if it does, else the inverse of a whole
  /// number, else the one with the fewest digits. 0 before the second time.
  double PeriodS() const;

 private:
  int64_t count_ = 0;
  double start_s_ = 0;
  double start_tolerance_s_ = 0;
  double first_step_s_ = 0;
  double last_s_ = 0;
  double low_s_ = 0;  // periods that fit
  double high_s_ = std::numeric_limits<double>::infinity();
};

/// Half a unit of the last digit of a decimal number: 0.005 for "1.25", 0.5 for "10", 50 for
/// "1.2e3".
double HalfLastDigit(std::string_view text);

}  // namespace metaekf::data
