#include "core/plot/axis.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

namespace metaekf::plot {
namespace {

/// "10⁻⁴" for −4.
std::string PowerOfTen(int exponent) {
  static constexpr const char* kSuperscripts[] = {"⁰", "¹", "²", "³", "⁴", "⁵", "⁶", "⁷", "⁸", "⁹"};
  std::string text = "10";
  for (const char c : std::to_string(exponent)) {
    text += c == '-' ? "⁻" : kSuperscripts[c - '0'];
  }
  return text;
}

/// `value` with `decimals` decimals, a real minus sign and no "−0".
std::string Fixed(double value, int decimals) {
  char digits[64];
  std::snprintf(digits, sizeof(digits), "%.*f", decimals, std::abs(value));
  const bool zero = std::string(digits).find_first_not_of("0.") == std::string::npos;
  return (value < 0 && !zero ? "−" : "") + std::string(digits);
}

/// The step of 1, 2 or 5 times a power of ten that cuts `length` into about `ticks` parts.
double NiceStep(double length, int ticks) {
  const double rough = length / ticks;
  const double power = std::pow(10.0, std::floor(std::log10(rough)));
  const double lead = rough / power;
  return power * (lead < 1.5 ? 1 : lead < 3.5 ? 2 : lead < 7.5 ? 5 : 10);
}

void AddLinearTicks(int ticks, Axis& axis) {
  const double step = NiceStep(axis.high - axis.low, ticks);
  const double largest = std::max(std::abs(axis.low), std::abs(axis.high));
  int exponent = static_cast<int>(std::floor(std::log10(largest)));
  // Plain numbers from thousandths to tens of thousands; beyond, a common factor.
  if (exponent >= -2 && exponent < 5) exponent = 0;
  if (exponent != 0) axis.factor = "×" + PowerOfTen(exponent);
  const double unit = std::pow(10.0, exponent);
  const int decimals = std::max(0, -static_cast<int>(std::floor(std::log10(step / unit) + 1e-9)));
  // By number, not by adding steps: a sum would drift off the round values.
  const double first = std::ceil(axis.low / step - 1e-9);
  const double last = std::floor(axis.high / step + 1e-9);
  for (double k = first; k <= last; ++k) {
    axis.ticks.push_back({k * step, Fixed(k * step / unit, decimals)});
  }
}

void AddLogarithmicTicks(int ticks, Axis& axis) {
  const int first = static_cast<int>(std::floor(std::log10(axis.low)));
  const int last = static_cast<int>(std::ceil(std::log10(axis.high)));
  const int stride = std::max(1, (last - first) / ticks);
  const bool narrow = last - first <= 4;
  for (int exponent = first; exponent <= last; ++exponent) {
    const double power = std::pow(10.0, exponent);
    for (int digit = 1; digit <= (narrow ? 9 : 1); ++digit) {
      const double value = digit * power;
      if (value < axis.low || value > axis.high) continue;
      // A range within a decade or two has few powers of ten in it: label 2 and 5 as well.
      const bool labelled = digit == 1 ? (exponent - first) % stride == 0
                                       : last - first <= 2 && (digit == 2 || digit == 5);
      std::string label;
      if (labelled) label = (digit > 1 ? std::to_string(digit) + "·" : "") + PowerOfTen(exponent);
      axis.ticks.push_back({value, label});
    }
  }
}

}  // namespace

double Axis::Position(double value) const {
  if (logarithmic) return std::log(value / low) / std::log(high / low);
  return (value - low) / (high - low);
}

Axis MakeAxis(double min, double max, bool logarithmic, double padding, int ticks) {
  Axis axis;
  axis.logarithmic = logarithmic;
  if (logarithmic) {
    const double ratio = max > min ? std::pow(max / min, padding) : 3;
    axis.low = min / ratio;
    axis.high = max * ratio;
    AddLogarithmicTicks(ticks, axis);
    return axis;
  }
  // A range below the resolution of labels and coordinates is no range.
  const double magnitude = std::max(std::abs(min), std::abs(max));
  double margin = padding * (max - min);
  if (!(max - min > 1e-12 * magnitude)) margin = magnitude > 0 ? 0.1 * magnitude : 1;
  axis.low = min - margin;
  axis.high = max + margin;
  AddLinearTicks(ticks, axis);
  return axis;
}

}  // namespace metaekf::plot
