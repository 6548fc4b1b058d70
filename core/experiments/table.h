#pragma once

#include <cstddef>
#include <string>
#include <vector>

namespace metaekf::experiments {

/// What is said of the values that one cell has from several runs.
enum class Summary {
  kMedian,  ///< median [lower quartile – upper quartile]
  kMean,    ///< mean ± standard deviation
};

/// One quantity. Runs without a finite value have failed: they count as worst in quantiles.
struct Column {
  std::string name;
  std::string unit;  ///< empty for a number
  bool larger_is_better = false;
};

struct Row {
  std::string label;
  std::vector<std::vector<double>> cells;  ///< values of every run; empty: not measured
};

/// A table of results over runs that differ in their seed.
struct Table {
  std::string name;  ///< of its file
  std::string title;
  Summary summary = Summary::kMedian;
  std::string row_heading;
  std::vector<Column> columns;
  std::vector<Row> rows;
  std::vector<std::string> notes;  ///< printed below
};

/// Statistics of one cell. Quantiles are over all runs, interpolated, failed ones at the bad end; mean and standard
/// deviation (divided by runs − 1) are over the finite ones. NaN where there is nothing to take them of.
struct Statistics {
  size_t runs = 0;
  size_t failed = 0;
  double mean = 0, standard_deviation = 0;
  double lower_quartile = 0, median = 0, upper_quartile = 0;
};

/// Mean of runs to rank by: infinite if there is none, or one has failed.
double MeanUnlessFailed(const std::vector<double>& runs);

Statistics Summarise(const std::vector<double>& runs, bool larger_is_better);

/// Aligned text for people, and CSV with every statistic: one line per row and column.
std::string ToText(const Table& table);
std::string ToCsv(const Table& table);

}  // namespace metaekf::experiments
