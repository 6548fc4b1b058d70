#include "core/base/numbers.h"

#include <charconv>
#include <cmath>
#include <cstdio>

namespace metaekf::base {

std::string FormatExact(double value) {
  if (std::isnan(value)) return "nan";
  char buffer[40];
  const auto result = std::to_chars(buffer, buffer + sizeof(buffer), value);
  return std::string(buffer, result.ptr);
}

std::string FormatShort(double value, int digits) {
  char buffer[64];
  const int length = std::snprintf(buffer, sizeof(buffer), "%.*g", digits, value);
  return std::string(buffer, static_cast<size_t>(length));
}

std::optional<double> ParseDouble(std::string_view text) {
  const auto is_blank = [](char c) { return c == ' ' || c == '\t' || c == '\r'; };
  while (!text.empty() && is_blank(text.front())) text.remove_prefix(1);
  while (!text.empty() && is_blank(text.back())) text.remove_suffix(1);
  if (!text.empty() && text.front() == '+') {
    text.remove_prefix(1);
    if (!text.empty() && text.front() == '-') return std::nullopt;
  }
  double value = 0;
  const auto result = std::from_chars(text.data(), text.data() + text.size(), value);
  if (text.empty() || result.ptr != text.data() + text.size()) return std::nullopt;
  if (result.ec == std::errc::result_out_of_range) {
    // from_chars leaves `value` alone beyond the range of double: tiny numbers are zero, huge ones infinite.
    const bool negative = text.front() == '-';
    const size_t exponent = text.find_first_of("eE");
    const bool tiny = exponent != std::string_view::npos ? text.substr(exponent + 1, 1) == "-"
                                                         : text.substr(negative ? 1 : 0, 2) == "0.";
    const double magnitude = tiny ? 0.0 : HUGE_VAL;
    return negative ? -magnitude : magnitude;
  }
  if (result.ec != std::errc()) return std::nullopt;
  return value;
}

double Quantile(const std::vector<double>& sorted, double share) {
  const double place = share * static_cast<double>(sorted.size() - 1);
  const size_t below = static_cast<size_t>(place);
  const double weight = place - static_cast<double>(below);
  if (weight == 0 || !std::isfinite(sorted[below])) return sorted[below];
  return sorted[below] + weight * (sorted[below + 1] - sorted[below]);
}

}  // namespace metaekf::base
