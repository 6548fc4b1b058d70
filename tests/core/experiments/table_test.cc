#include "core/experiments/table.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>

namespace metaekf::experiments {
namespace {

using ::testing::HasSubstr;

constexpr double kInfinity = std::numeric_limits<double>::infinity();

Table Example(Summary summary) {
  return {.name = "example", .title = "Errors", .summary = summary, .row_heading = "model",
          .columns = {{"RMSE", "m"}, {"Fit", "%", true}},
          .rows = {{"MAML, exact", {{1, 2, 4, 3}, {90, 80, 70, 60}}}, {"θ", {{kInfinity, 2, 1, 3}, {}}}},
          .notes = {"A note."}};
}

TEST(TableTest, StatisticsOfFourRuns) {
  // By hand: quartiles of 1 2 3 4 at 1.75, 2.5, 3.25; squared deviations from 2.5 add to 5, over 3.
  const Statistics s = Summarise({1, 2, 4, 3}, false);
  EXPECT_EQ(s.runs, 4u);
  EXPECT_EQ(s.failed, 0u);
  EXPECT_DOUBLE_EQ(s.mean, 2.5);
  EXPECT_DOUBLE_EQ(s.standard_deviation, std::sqrt(5.0 / 3));
  EXPECT_DOUBLE_EQ(s.lower_quartile, 1.75);
  EXPECT_DOUBLE_EQ(s.median, 2.5);
  EXPECT_DOUBLE_EQ(s.upper_quartile, 3.25);
}

TEST(TableTest, FailedRunsAreTheWorst) {
  const Statistics error = Summarise({std::nan(""), 2, 1}, false);
  EXPECT_EQ(error.failed, 1u);
  EXPECT_EQ(error.mean, 1.5);
  EXPECT_EQ(error.median, 2);
  EXPECT_EQ(error.upper_quartile, 2 + kInfinity);
  EXPECT_EQ(Summarise({kInfinity, 2, 1}, true).median, 1);  // of a quantity that should be large
  EXPECT_EQ(Summarise({kInfinity, kInfinity, 1}, false).median, kInfinity);
}

TEST(TableTest, WhoHasFailedOnceRanksLast) {
  EXPECT_EQ(MeanUnlessFailed({1, 3}), 2);
  EXPECT_TRUE(std::isinf(MeanUnlessFailed({1, std::nan("")})));
  EXPECT_TRUE(std::isinf(MeanUnlessFailed({})));
}

TEST(TableTest, OfNoRunsThereIsNothingToSay) {
  EXPECT_TRUE(std::isnan(Summarise({}, false).median));
  EXPECT_TRUE(std::isnan(Summarise({kInfinity}, false).mean));
  EXPECT_TRUE(std::isnan(Summarise({1}, false).standard_deviation));
  EXPECT_EQ(Summarise({1}, false).median, 1);
}

TEST(TableTest, TextIsAlignedAndSaysWhatFailed) {
  // "MAML, exact" has 11 characters, "2.5 [1.75 – failed] (1 of 4 failed)" 35; two blanks stand between columns.
  EXPECT_EQ(ToText(Example(Summary::kMedian)),
            "Errors\n"
            "model        RMSE (m)                             Fit (%)\n"
            "MAML, exact  2.5 [1.75 – 3.25]                    75 [67.5 – 82.5]\n"
            "θ            2.5 [1.75 – failed] (1 of 4 failed)\n"
            "A note.\n");
  EXPECT_THAT(ToText(Example(Summary::kMean)), HasSubstr("2.5 ± 1.29"));
}

TEST(TableTest, CsvHasEveryStatisticOfEveryCellThatWasMeasured) {
  EXPECT_EQ(ToCsv(Example(Summary::kMedian)),
            "model,quantity,unit,runs,failed,mean,standard_deviation,lower_quartile,median,upper_quartile\n"
            "\"MAML, exact\",RMSE,m,4,0,2.5,1.2909944487358056,1.75,2.5,3.25\n"
            "\"MAML, exact\",Fit,%,4,0,75,12.909944487358056,67.5,75,82.5\n"
            "θ,RMSE,m,4,1,2,1,1.75,2.5,inf\n");
}

}  // namespace
}  // namespace metaekf::experiments
