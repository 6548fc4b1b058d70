#include "client/cli/estimate_rows.h"

#include <gtest/gtest.h>

#include <cmath>

namespace metaekf::cli {
namespace {

const double kNaN = std::nan("");

TEST(EstimateRowsTest, TheHeaderNamesStatesOrOutputs) {
  // The contract's columns.
  EXPECT_EQ(EstimateHeader({{"x1", ""}, {"x2", ""}}, true, false), "t,x1,x2,sx1,sx2,nis,health,flags\n");
  EXPECT_EQ(EstimateHeader({{"y1", "m"}}, false, false), "t,y1_hat,sy1,nis,health,flags\n");
  EXPECT_EQ(EstimateHeader({{"x1", ""}}, true, true), "t,x1,sx1,nis,health,flags,slack,projection\n");
}

TEST(EstimateRowsTest, RowsReadBackExactlyAndLeaveOutWhatIsNotThere) {
  client::EstimateBatch batch{.samples = 2,
                              .times_s = {0.1, 0.2},
                              .means = {1.0 / 3, -2, kNaN, kNaN},
                              .covariances = {4, 0.25, kNaN, kNaN},
                              .nis = {1e-300, kNaN},
                              .health = {client::Health::kConsistent, client::Health::kWarmingUp},
                              .flags = {0, client::kMissing | client::kReset}};
  // Deviations are roots of the variances.
  EXPECT_EQ(EstimateRow(batch, 0), "0.1,0.3333333333333333,-2,2,0.5,1e-300,consistent,\n");
  EXPECT_EQ(EstimateRow(batch, 1), "0.2,,,,,,warming_up,missing|reset\n");
}

TEST(EstimateRowsTest, ConstrainedRowsEndWithSlackAndProjection) {
  const client::EstimateBatch batch{.samples = 1,
                                    .times_s = {0},
                                    .means = {1},
                                    .covariances = {4},
                                    .nis = {2},
                                    .health = {client::Health::kConsistent},
                                    .flags = {client::kProjected},
                                    .slacks = {-0.25},
                                    .projections = {0.25}};
  EXPECT_EQ(EstimateRow(batch, 0), "0,1,2,2,consistent,projected,-0.25,0.25\n");
}

TEST(EstimateRowsTest, WordsAreThoseOfTheContract) {
  EXPECT_EQ(FlagWords(63), "missing|gated|projected|delayed|reset|adapted");
  EXPECT_EQ(FlagWords(0), "");
  EXPECT_STREQ(HealthWord(client::Health::kOverconfident), "overconfident");
  EXPECT_STREQ(HealthWord(client::Health::kDiverged), "diverged");
}

}  // namespace
}  // namespace metaekf::cli
