#include "core/data/split.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <numeric>

namespace metaekf::data {
namespace {

using ::testing::ElementsAre;
using ::testing::ElementsAreArray;

Trajectory Counting(Eigen::Index length) {
  Trajectory trajectory{"a", 10, 0.5, {}, {}, {}};
  trajectory.inputs.resize(0, length);
  trajectory.outputs = Eigen::RowVectorXd::LinSpaced(length, 0, static_cast<double>(length - 1));
  trajectory.states = 2 * trajectory.outputs;
  return trajectory;
}

TEST(SplitTest, EverySystemIsOnOneSideOnly) {
  for (const size_t count : {2u, 5u, 160u}) {
    const auto split = SplitSystems(count, 0.2, 7);
    ASSERT_TRUE(split.ok());
    EXPECT_TRUE(std::is_sorted(split->training.begin(), split->training.end()));
    EXPECT_TRUE(std::is_sorted(split->validation.begin(), split->validation.end()));
    std::vector<size_t> all = split->training;
    all.insert(all.end(), split->validation.begin(), split->validation.end());
    std::sort(all.begin(), all.end());
    std::vector<size_t> expected(count);
    std::iota(expected.begin(), expected.end(), size_t{0});
    EXPECT_THAT(all, ElementsAreArray(expected));
  }
}

TEST(SplitTest, HoldsOutTheShareRoundedButLeavesBothSidesSomething) {
  // By hand: 0.2 · 160 = 32; 0.1 · 2 rounds to 0, raised to 1; 0.9 · 2 rounds to 2, lowered to 1.
  EXPECT_EQ(SplitSystems(160, 0.2, 1)->validation.size(), 32u);
  EXPECT_EQ(SplitSystems(2, 0.1, 1)->validation.size(), 1u);
  EXPECT_EQ(SplitSystems(2, 0.9, 1)->training.size(), 1u);
  EXPECT_EQ(SplitSystems(1, 0, 1)->training.size(), 1u);
  EXPECT_TRUE(SplitSystems(9, 0, 1)->validation.empty());
}

TEST(SplitTest, TheSeedDecidesAndNothingElse) {
  EXPECT_EQ(SplitSystems(160, 0.2, 3)->validation, SplitSystems(160, 0.2, 3)->validation);
  EXPECT_NE(SplitSystems(160, 0.2, 3)->validation, SplitSystems(160, 0.2, 4)->validation);
}

TEST(SplitTest, EverySystemIsHeldOutAboutEquallyOften) {
  // 10 systems, 3 held out, 2000 seeds: 600 each, standard deviation √(2000 · 0.3 · 0.7) = 20.5;
  // five of them.
  std::vector<int> held_out(10, 0);
  for (uint64_t seed = 0; seed < 2000; ++seed) {
    const auto split = SplitSystems(10, 0.3, seed);
    for (const size_t index : split->validation) ++held_out[index];
  }
  for (const int count : held_out) EXPECT_NEAR(count, 600, 103);
}

TEST(SplitTest, RefusesSharesAndCountsThatCannotBe) {
  for (const double share : {-0.1, 1.0, std::nan("")}) {
    EXPECT_EQ(SplitSystems(10, share, 1).status().code(), absl::StatusCode::kInvalidArgument);
  }
  EXPECT_EQ(SplitSystems(0, 0, 1).status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(SplitSystems(1, 0.5, 1).status().code(), absl::StatusCode::kInvalidArgument);
}

TEST(SplitTest, ASubsetKeepsNamesAndOrder) {
  Dataset dataset{{"u1"}, {"y1"}, {"x1"}, {Counting(1), Counting(2), Counting(3)}};
  const auto subset = Subset(dataset, {2, 0});
  ASSERT_TRUE(subset.ok());
  EXPECT_THAT(subset->output_names, ElementsAre("y1"));
  ASSERT_EQ(subset->trajectories.size(), 2u);
  EXPECT_EQ(subset->trajectories[0].length(), 3);
  EXPECT_EQ(subset->trajectories[1].length(), 1);
  EXPECT_EQ(Subset(dataset, {3}).status().code(), absl::StatusCode::kOutOfRange);
}

TEST(SplitTest, CutsAtASampleAndKeepsTime) {
  const auto first = FirstSamples(Counting(10), 4);
  const auto rest = SamplesFrom(Counting(10), 4);
  ASSERT_TRUE(first.ok() && rest.ok());
  EXPECT_EQ(first->outputs, (Eigen::MatrixXd(1, 4) << 0, 1, 2, 3).finished());
  EXPECT_EQ(first->start_s, 10);
  EXPECT_EQ(first->inputs.cols(), 4);
  // By hand: sample 4 stands at 10 + 4 · 0.5 s, and the states are twice the outputs.
  EXPECT_EQ(rest->length(), 6);
  EXPECT_EQ(rest->start_s, 12);
  EXPECT_EQ(rest->states(0, 0), 8);
  EXPECT_EQ(rest->name, "a");
  EXPECT_EQ(rest->sample_period_s, 0.5);
}

TEST(SplitTest, RefusesToCutOutsideTheTrajectory) {
  EXPECT_EQ(FirstSamples(Counting(3), 3)->length(), 3);
  EXPECT_EQ(SamplesFrom(Counting(3), 3)->length(), 0);
  for (const Eigen::Index asked : {-1, 4}) {
    EXPECT_EQ(FirstSamples(Counting(3), asked).status().code(), absl::StatusCode::kOutOfRange);
    EXPECT_EQ(SamplesFrom(Counting(3), asked).status().code(), absl::StatusCode::kOutOfRange);
  }
}

}  // namespace
}  // namespace metaekf::data
