#include "server/metrics/metrics.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <map>

namespace metaekf::server {
namespace {

using ::testing::SizeIs;

class MetricsTest : public ::testing::Test {
 protected:
  prometheus::MetricFamily Family(const std::string& name) {
    for (const prometheus::MetricFamily& family : metrics_.Collect()) {
      if (family.name == name) return family;
    }
    ADD_FAILURE() << name;
    return {};
  }
  Metrics metrics_;
};

TEST_F(MetricsTest, SamplesAreCountedByTenant) {
  const std::vector<double> nis = {0.2, std::nan(""), 1.0, 200};
  metrics_.CountBatch(metrics_.OfStreams("plant"), nis, 2, 1, absl::Microseconds(30));
  metrics_.CountBatch(metrics_.OfStreams("plant"), {1.5}, 0, 0, absl::Microseconds(30));
  metrics_.CountBatch(metrics_.OfStreams("works"), {1.5}, 0, 0, absl::Seconds(2));
  const auto samples = Family("metaekf_samples_total");
  ASSERT_EQ(samples.metric.size(), 2u);
  std::map<std::string, double> counts;
  for (const auto& metric : samples.metric) counts[metric.label[0].value] = metric.counter.value;
  EXPECT_EQ(counts, (std::map<std::string, double>{{"plant", 5}, {"works", 1}}));
  const auto gated = Family("metaekf_gated_samples_total");
  EXPECT_EQ(gated.metric[0].counter.value + gated.metric[1].counter.value, 2);

  const auto histogram = Family("metaekf_nis").metric[0].histogram;
  EXPECT_EQ(histogram.sample_count, 5u);  // what was not measured has none
  EXPECT_DOUBLE_EQ(histogram.sample_sum, 204.2);
  for (const auto& bucket : histogram.bucket) {
    // By hand: 0.2, 1.0, 1.5, 1.5 and 200.
    const double bound = bucket.upper_bound;
    const uint64_t expected = (bound >= 0.2) + (bound >= 1) + 2 * (bound >= 1.5) + (bound >= 200);
    EXPECT_EQ(bucket.cumulative_count, expected) << bound;
  }
  const auto latency = Family("metaekf_estimate_seconds").metric[0].histogram;
  EXPECT_EQ(latency.sample_count, 3u);
  EXPECT_EQ(latency.bucket[1].cumulative_count, 2u);  // up to 50 µs
  EXPECT_EQ(latency.bucket.back().cumulative_count, 3u);
}

TEST_F(MetricsTest, CallsAreCountedByMethodAndCode) {
  metrics_.CountCall("GetModel", "OK", absl::Milliseconds(1));
  metrics_.CountCall("GetModel", "NOT_FOUND", absl::Milliseconds(1));
  metrics_.CountCall("GetModel", "OK", absl::Milliseconds(1));
  EXPECT_THAT(Family("metaekf_calls_total").metric, SizeIs(2));
  EXPECT_EQ(Family("metaekf_call_seconds").metric[0].histogram.sample_count, 3u);
}

TEST_F(MetricsTest, GaugesAreAskedWhenSomebodyLooks) {
  double value = 1;
  metrics_.AddGauges([&] { return Metrics::Families{MakeGauges("a_gauge", "help", "kind", {{"x", value}, {"", 7}})}; });
  EXPECT_EQ(Family("a_gauge").metric[0].gauge.value, 1);
  value = 2;
  const auto family = Family("a_gauge");
  EXPECT_EQ(family.metric[0].gauge.value, 2);
  EXPECT_EQ(family.metric[0].label[0].name, "kind");
  EXPECT_THAT(family.metric[1].label, SizeIs(0));
}

TEST(ProcessMetricsTest, TellWhatTheProcessUses) {
  const Metrics::Families families = ProcessMetrics();
  ASSERT_THAT(families, SizeIs(3));
  EXPECT_GT(families[0].metric[0].counter.value, 0);
  EXPECT_GE(families[1].metric[0].gauge.value, 3);
  EXPECT_GT(families[2].metric[0].gauge.value, 1e6);
}

}  // namespace
}  // namespace metaekf::server
