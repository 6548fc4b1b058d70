#pragma once

#include <cstddef>
#include <vector>

namespace metaekf::plot {

/// The points of a curve that suffice to draw it: all of them if there are at most `most`,
/// otherwise, of each of most/4 stretches, those with the least and greatest x and y, so that no
/// peak is lost.
///
/// A point with a value that is not finite is a gap. A stretch keeps one gap if it has nothing
/// else: a single lost sample among many does not cut a curve that is drawn from thousands.
///
/// @return indices, ascending. `most` is at least 4.
std::vector<size_t> Decimate(const std::vector<double>& x, const std::vector<double>& y,
                             size_t most);

}  // namespace metaekf::plot
