#pragma once

#include <string>
#include <vector>

namespace metaekf::benchmark {

/// A figure beside that of its peer.
struct Row {
  std::string what, unit;
  double ours = 0, peer = 0;  ///< NaN: not measured
  double ratio = 0;           ///< as large as it is good, or NaN
  std::string key;            ///< of the ratio in the JSON file; empty: not there
};

/// The middle of an odd number of values, the lower of the two of an even one.
double Median(std::vector<double> values);
/// @param share  0.99 for the p99.
double Quantile(std::vector<double> values, double share);

void Print(const std::string& title, const std::vector<Row>& rows);

/// Adds rows to a JSON file, which may be there already: {"ratios": {key: ratio}, "figures": [{what, unit, metaekf, peer, ratio}]}.
/// @return whether the file could be written.
bool AddToJson(const std::string& path, const std::vector<Row>& rows);

}  // namespace metaekf::benchmark
