#pragma once

#include <string>
#include <vector>

namespace metaekf::plot {

/// Where a grid line stands and what is written at it (nothing at minor lines).
struct Tick {
  double value = 0;
  std::string label;
};

/// A linear or decimal-logarithmic axis with round ticks.
struct Axis {
  double low = 0;  ///< both ends are finite, low < high; positive on a logarithmic axis
  double high = 1;
  bool logarithmic = false;
  std::vector<Tick> ticks;  ///< inside [low, high], ascending
  std::string factor;       ///< what the labels are multiplied by, e.g. "×10⁻⁴"; empty for 1

  /// Position of a value: 0 at `low`, 1 at `high`.
  double Position(double value) const;
};

/// An axis over [min, max] plus `padding` times its length on either side (of a logarithmic axis,
/// in decades), with steps of 1, 2 or 5 times a power of ten and about `ticks` of them, 2 or more.
/// Ends that are equal are moved apart; a logarithmic axis needs 0 < min.
Axis MakeAxis(double min, double max, bool logarithmic, double padding, int ticks);

}  // namespace metaekf::plot
