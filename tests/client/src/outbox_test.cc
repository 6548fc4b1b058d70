#include "client/src/outbox.h"

#include <gtest/gtest.h>

namespace metaekf::client {
namespace {

constexpr size_t kAll = 1000;

v1::SampleBatch Samples(int count) {
  v1::SampleBatch batch;
  for (int i = 0; i < count; ++i) batch.add_outputs(i);
  return batch;
}

class OutboxTest : public ::testing::Test {
 protected:
  /// What would be sent again: the first number of samples, or 0 for a forecast.
  std::vector<uint64_t> Again() {
    std::vector<uint64_t> all;
    uint64_t id = 0;
    while (const auto entry = outbox_.After(id)) {
      id = entry->id;
      all.push_back(entry->last_seq == 0 ? 0 : entry->request->samples().first_seq());
    }
    return all;
  }
  Outbox outbox_;
};

TEST_F(OutboxTest, NumbersGoOn) {
  EXPECT_EQ(outbox_.Add(Samples(3), 3).last_seq, 3u);
  EXPECT_EQ(outbox_.Add(Samples(2), 2).request->samples().first_seq(), 4u);
  EXPECT_EQ(outbox_.sent_seq(), 5u);
  Outbox resumed;
  resumed.Begin(8);
  EXPECT_EQ(resumed.Add(Samples(1), 1).last_seq, 9u);
}

TEST_F(OutboxTest, EachBatchTellsWhatHasArrived) {
  EXPECT_EQ(outbox_.Add(Samples(3), 3).request->samples().received_seq(), 0u);
  outbox_.Answered(2, 0, kAll);
  EXPECT_EQ(outbox_.Add(Samples(3), 3).request->samples().received_seq(), 2u);
}

TEST_F(OutboxTest, WhatIsDurableIsForgotten) {
  for (int i = 0; i < 3; ++i) outbox_.Add(Samples(2), 2);
  outbox_.Answered(6, 0, kAll);
  EXPECT_EQ(Again(), (std::vector<uint64_t>{1, 3, 5}));
  outbox_.Answered(6, 3, kAll);  // the second only in part
  EXPECT_EQ(Again(), (std::vector<uint64_t>{3, 5}));
  EXPECT_EQ(outbox_.oldest_seq(), 3u);
  outbox_.Begin(6);
  EXPECT_EQ(Again(), std::vector<uint64_t>{});
  EXPECT_EQ(outbox_.oldest_seq(), 7u);
}

TEST_F(OutboxTest, ForecastsStayInTheirPlaceUntilTheyAreAnswered) {
  outbox_.Add(Samples(1), 1);
  outbox_.Add(v1::ForecastRequest());
  outbox_.Add(Samples(1), 1);
  outbox_.Add(v1::ForecastRequest());
  EXPECT_EQ(Again(), (std::vector<uint64_t>{1, 0, 2, 0}));
  outbox_.Answered(1, 1, kAll);
  EXPECT_EQ(Again(), (std::vector<uint64_t>{0, 2, 0}));
  outbox_.ForecastAnswered();
  EXPECT_EQ(Again(), (std::vector<uint64_t>{2, 0}));
  outbox_.ForecastAnswered();
  outbox_.ForecastAnswered();  // that nobody asked for
  EXPECT_EQ(Again(), std::vector<uint64_t>{2});
}

TEST_F(OutboxTest, WhereNothingBecomesDurableTheLatestAreKept) {
  for (int i = 0; i < 10; ++i) outbox_.Add(Samples(1), 1);
  outbox_.Answered(9, 0, 4);
  EXPECT_EQ(Again(), (std::vector<uint64_t>{7, 8, 9, 10}));
  outbox_.Answered(9, 0, 1);  // the last has not been answered
  EXPECT_EQ(Again(), std::vector<uint64_t>{10});
}

TEST_F(OutboxTest, WhatIsRefusedIsForgottenWithAllThatFollows) {
  for (int i = 0; i < 4; ++i) outbox_.Add(Samples(2), 2);
  outbox_.Add(v1::ForecastRequest());
  outbox_.Answered(4, 2, kAll);
  outbox_.Refused();
  EXPECT_EQ(Again(), std::vector<uint64_t>{3});
  EXPECT_EQ(outbox_.Add(Samples(1), 1).last_seq, 5u);
}

TEST_F(OutboxTest, AnEntryOutlivesBeingForgotten) {
  const Outbox::Entry entry = outbox_.Add(Samples(2), 2);
  outbox_.Answered(2, 2, kAll);
  EXPECT_EQ(entry.request->samples().outputs_size(), 2);
}

}  // namespace
}  // namespace metaekf::client
