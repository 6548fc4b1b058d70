#include "server/session/sample_rate.h"

#include <gtest/gtest.h>

namespace metaekf::server {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;

TEST(SampleRateTest, ASecondOfSamplesMayComeAtOnceThenTheyComeAtTheRate) {
  SampleRate rate(100);
  SampleRate::Time now = SampleRate::Time() + seconds(1000);
  ASSERT_TRUE(rate.IsReady(now));
  rate.Count(100, now);
  EXPECT_TRUE(rate.IsReady(now));
  rate.Count(50, now);  // which take half a second
  EXPECT_FALSE(rate.IsReady(now));
  EXPECT_FALSE(rate.IsReady(now + milliseconds(499)));
  EXPECT_TRUE(rate.IsReady(now + milliseconds(500)));
}

TEST(SampleRateTest, WhatIsNotUsedIsSavedForASecondAtMost) {
  SampleRate rate(100);
  SampleRate::Time now = SampleRate::Time() + seconds(1000);
  rate.Count(1, now);
  now += seconds(60);
  rate.Count(101, now);
  EXPECT_FALSE(rate.IsReady(now));
  EXPECT_TRUE(rate.IsReady(now + milliseconds(10)));
}

// Over a long time, whatever the batches.
TEST(SampleRateTest, TheRateIsKept) {
  SampleRate rate(1000);
  const SampleRate::Time start = SampleRate::Time() + seconds(1000);
  int64_t samples = 0;
  for (SampleRate::Time now = start; now < start + seconds(20); now += milliseconds(50)) {
    for (int64_t batch = 1; rate.IsReady(now); batch = batch % 64 + 1) {
      rate.Count(batch, now);
      samples += batch;
    }
  }
  EXPECT_NEAR(static_cast<double>(samples), 21'000, 100);
}

TEST(SampleRatesTest, TenantsWithALimitHaveOneRateEach) {
  store::Quotas quotas;
  quotas.by_tenant["plant"].samples_per_s = 10;
  quotas.by_tenant["works"].samples_per_s = 10;
  SampleRates rates(quotas);
  EXPECT_EQ(rates.Of("other"), nullptr);
  EXPECT_NE(rates.Of("plant"), nullptr);
  EXPECT_EQ(rates.Of("plant"), rates.Of("plant"));
  EXPECT_NE(rates.Of("plant"), rates.Of("works"));
}

}  // namespace
}  // namespace metaekf::server
