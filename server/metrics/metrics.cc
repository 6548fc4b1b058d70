#include "server/metrics/metrics.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace metaekf::server {
namespace {

using prometheus::Counter;
using prometheus::Histogram;

// A sample a batch takes 10 µs, a large model's batch of many samples seconds.
const Histogram::BucketBoundaries kEstimateSeconds = {25e-6, 50e-6, 100e-6, 250e-6, 500e-6, 1e-3, 2.5e-3,
                                                      5e-3,  10e-3, 25e-3,  100e-3, 1};
const Histogram::BucketBoundaries kSeconds = {1e-3, 2.5e-3, 5e-3, 10e-3, 25e-3, 50e-3, 100e-3, 250e-3, 1, 2.5, 10, 60};
// Around the chi-squared distributions of one to a dozen outputs.
const Histogram::BucketBoundaries kNis = {0.1, 0.25, 0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30, 50, 100};
const Histogram::BucketBoundaries kRatio = {0.001, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1};

prometheus::Family<Counter>& Counters(prometheus::Registry& registry, const char* name, const char* help) {
  return prometheus::BuildCounter().Name(name).Help(help).Register(registry);
}

prometheus::Family<Histogram>& Histograms(prometheus::Registry& registry, const char* name, const char* help) {
  return prometheus::BuildHistogram().Name(name).Help(help).Register(registry);
}

}  // namespace

Metrics::Metrics()
    : samples_(Counters(registry_, "metaekf_samples_total", "Samples that streams have had estimates of")),
      gated_(Counters(registry_, "metaekf_gated_samples_total", "Samples with outliers that the gate kept out")),
      resets_(Counters(registry_, "metaekf_filter_resets_total", "Filters that diverged and began anew")),
      calls_(Counters(registry_, "metaekf_calls_total", "Calls that have ended")),
      estimate_seconds_(Histograms(registry_, "metaekf_estimate_seconds",
                                   "From a batch of samples being read to its estimates being ready")
                            .Add({}, kEstimateSeconds)),
      nis_(Histograms(registry_, "metaekf_nis", "Normalised innovations squared of samples").Add({}, kNis)),
      checkpoints_(Counters(registry_, "metaekf_checkpoints_total", "Checkpoints of sessions written").Add({})),
      checkpoint_seconds_(Histograms(registry_, "metaekf_checkpoint_commit_seconds",
                                     "To bring the checkpoints of all sessions that changed to disk")
                              .Add({}, kSeconds)),
      adaptation_seconds_(
          Histograms(registry_, "metaekf_adaptation_seconds", "Adaptations, from their last sample on").Add({}, kSeconds)),
      loss_ratio_(Histograms(registry_, "metaekf_adaptation_loss_ratio",
                             "Loss on the context after an adaptation as a part of that before")
                      .Add({}, kRatio)),
      call_seconds_(Histograms(registry_, "metaekf_call_seconds", "Calls, from their start to their end")) {}

StreamCounters Metrics::OfStreams(const std::string& tenant) {
  return {&samples_.Add({{"tenant", tenant}}), &gated_.Add({{"tenant", tenant}}), &resets_.Add({{"tenant", tenant}})};
}

void Metrics::CountBatch(const StreamCounters& counters, absl::Span<const double> nis, int64_t gated, int64_t resets,
                         absl::Duration latency) {
  counters.samples->Increment(static_cast<double>(nis.size()));
  if (gated > 0) counters.gated->Increment(static_cast<double>(gated));
  if (resets > 0) counters.resets->Increment(static_cast<double>(resets));
  estimate_seconds_.Observe(absl::ToDoubleSeconds(latency));
  thread_local std::vector<double> counts;
  counts.assign(kNis.size() + 1, 0.0);
  double sum = 0;
  for (const double value : nis) {
    if (std::isnan(value)) continue;
    counts[static_cast<size_t>(std::lower_bound(kNis.begin(), kNis.end(), value) - kNis.begin())] += 1;
    sum += value;
  }
  nis_.ObserveMultiple(counts, sum);
}

void Metrics::CountCheckpoints(int64_t sessions, absl::Duration duration) {
  checkpoints_.Increment(static_cast<double>(sessions));
  checkpoint_seconds_.Observe(absl::ToDoubleSeconds(duration));
}

void Metrics::CountAdaptation(absl::Duration duration, double before, double after) {
  adaptation_seconds_.Observe(absl::ToDoubleSeconds(duration));
  if (before > 0) loss_ratio_.Observe(after / before);
}

void Metrics::CountCall(const std::string& method, const std::string& code, absl::Duration duration) {
  calls_.Add({{"method", method}, {"code", code}}).Increment();
  call_seconds_.Add({{"method", method}}, kSeconds).Observe(absl::ToDoubleSeconds(duration));
}

void Metrics::AddGauges(std::function<Families()> gauges) {
  std::lock_guard lock(mutex_);
  gauges_.push_back(std::move(gauges));
}

Metrics::Families Metrics::Collect() const {
  Families all = registry_.Collect();
  {
    std::lock_guard lock(mutex_);
    for (const auto& gauges : gauges_) {
      for (prometheus::MetricFamily& family : gauges()) all.push_back(std::move(family));
    }
  }
  std::sort(all.begin(), all.end(), [](const auto& a, const auto& b) { return a.name < b.name; });
  return all;
}

prometheus::MetricFamily MakeGauges(const std::string& name, const std::string& help, const std::string& label_name,
                                    const std::vector<Gauge>& gauges) {
  prometheus::MetricFamily family{.name = name, .help = help, .type = prometheus::MetricType::Gauge, .metric = {}};
  for (const Gauge& gauge : gauges) {
    prometheus::ClientMetric& metric = family.metric.emplace_back();
    if (!gauge.label.empty()) metric.label.push_back({label_name, gauge.label});
    metric.gauge.value = gauge.value;
  }
  return family;
}

}  // namespace metaekf::server
