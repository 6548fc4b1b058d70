#include <algorithm>
#include <cmath>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "client/cli/commands.h"
#include "client/cli/records.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

/// Below which a share of the values lies, taken as spread evenly between two bounds; of those beyond the last finite bound,
/// that bound. NaN if there are none.
double Quantile(const client::Metric::Histogram& histogram, double share) {
  const double wanted = share * static_cast<double>(histogram.count);
  double low = 0, below = 0;
  for (size_t b = 0; b < histogram.upper_bounds.size() && histogram.count > 0; ++b) {
    const double high = histogram.upper_bounds[b];
    const double count = static_cast<double>(histogram.cumulative_counts[b]);
    if (std::isinf(high)) return low;
    if (count >= wanted) return low + (high - low) * (wanted - below) / std::max(1.0, count - below);
    low = high;
    below = count;
  }
  return std::nan("");
}

Record Row(const client::MetricFamily& family, const std::string& of, const std::string& what, double value) {
  return {{"metric", family.name}, {"of", of}, {"what", what}, {"value", value}, {"help", family.help}};
}

absl::Status PrintStatus(Console& console) {
  METAEKF_ASSIGN_OR_RETURN(const auto families, ToAbsl(console.client().GetMetrics()));
  std::vector<Record> records;
  for (const client::MetricFamily& family : families) {
    for (const client::Metric& metric : family.metrics) {
      const std::string of = absl::StrJoin(metric.labels, " ", absl::PairFormatter("="));
      if (!metric.histogram) {
        records.push_back(Row(family, of, "", metric.value));
        continue;
      }
      const auto& histogram = *metric.histogram;
      records.push_back(Row(family, of, "count", static_cast<double>(histogram.count)));
      if (histogram.count == 0) continue;
      records.push_back(Row(family, of, "mean", histogram.sum / static_cast<double>(histogram.count)));
      records.push_back(Row(family, of, "median", Quantile(histogram, 0.5)));
      records.push_back(Row(family, of, "99 %", Quantile(histogram, 0.99)));
    }
  }
  PrintRecords(console, {"metric", "of", "what", "value", "help"}, records);
  return absl::OkStatus();
}

}  // namespace

void AddStatus(CLI::App& app, Console& console, Command& chosen) {
  auto* command = app.add_subcommand(
      "status", "What the server counts and measures: sessions, samples, latencies, jobs, memory");
  OnChosen(command, chosen, [&console] { return PrintStatus(console); });
}

}  // namespace metaekf::cli
