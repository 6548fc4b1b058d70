#pragma once

#include <prometheus/counter.h>
#include <prometheus/histogram.h>
#include <prometheus/registry.h>

#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "absl/time/time.h"
#include "absl/types/span.h"

namespace metaekf::server {

/// What the streams of one tenant count. Safe to call concurrently.
struct StreamCounters {
  prometheus::Counter* samples;
  prometheus::Counter* gated;
  prometheus::Counter* resets;
};

/// All counters and gauges of a server. Safe to call concurrently.
class Metrics : public prometheus::Collectable {
 public:
  using Families = std::vector<prometheus::MetricFamily>;

  Metrics();

  StreamCounters OfStreams(const std::string& tenant);
  /// A batch was answered. @param nis  of its samples, NaN where nothing was measured.
  void CountBatch(const StreamCounters& counters, absl::Span<const double> nis, int64_t gated, int64_t resets,
                  absl::Duration latency);
  /// Checkpoints of sessions were written in one commit.
  void CountCheckpoints(int64_t sessions, absl::Duration duration);
  /// @param before, after  the loss on the context, first and last step.
  void CountAdaptation(absl::Duration duration, double before, double after);
  /// A call has ended. @param code  as gRPC names it.
  void CountCall(const std::string& method, const std::string& code, absl::Duration duration);

  /// What `gauges` says when somebody looks. It may block, and is called for nobody else meanwhile.
  void AddGauges(std::function<Families()> gauges);

  Families Collect() const override;

 private:
  prometheus::Registry registry_;
  prometheus::Family<prometheus::Counter>& samples_;
  prometheus::Family<prometheus::Counter>& gated_;
  prometheus::Family<prometheus::Counter>& resets_;
  prometheus::Family<prometheus::Counter>& calls_;
  prometheus::Histogram& estimate_seconds_;
  prometheus::Histogram& nis_;
  prometheus::Counter& checkpoints_;
  prometheus::Histogram& checkpoint_seconds_;
  prometheus::Histogram& adaptation_seconds_;
  prometheus::Histogram& loss_ratio_;
  prometheus::Family<prometheus::Histogram>& call_seconds_;

  mutable std::mutex mutex_;  // of gauges_, also while they are asked
  std::vector<std::function<Families()>> gauges_;
};

/// A gauge for AddGauges.
struct Gauge {
  std::string label;  ///< the value of its one label; empty: it has none
  double value = 0;
};
/// @param label_name  of all gauges that have a label.
prometheus::MetricFamily MakeGauges(const std::string& name, const std::string& help, const std::string& label_name,
                                    const std::vector<Gauge>& gauges);

/// Memory, open files and processor time of this process, under the names that Prometheus gives them.
Metrics::Families ProcessMetrics();

}  // namespace metaekf::server
