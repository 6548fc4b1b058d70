#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/client/run.h"

namespace metaekf::testing {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;

TEST(ReproduceTest, HelpListsTheExperiments) {
  const Outcome outcome = RunMetaekf({"reproduce", "--help"});
  EXPECT_EQ(outcome.status, 0);
  EXPECT_THAT(outcome.out, AllOf(HasSubstr("Usage: metaekf reproduce"), HasSubstr("van-der-pol-comparison: ")));
}

TEST(ReproduceTest, AnUnknownExperimentIsAnsweredWithThoseThatExist) {
  const Outcome outcome = RunMetaekf({"reproduce", "pendulum"});
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, AllOf(HasSubstr("\"pendulum\""), HasSubstr("van-der-pol-comparison")));
  EXPECT_EQ(outcome.out, "");
}

TEST(ReproduceTest, ADirectoryThatCannotBeWrittenIsNamedBeforeAnythingIsComputed) {
  const Outcome outcome = RunMetaekf({"reproduce", "van-der-pol-comparison", "--out", "/proc/no/such"});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, HasSubstr("/proc/no/such"));
}

TEST(ReproduceTest, WrongOptionsAreWrongUsage) {
  for (const auto& arguments : std::vector<std::vector<std::string>>{
           {"reproduce"},
           {"reproduce", "van-der-pol-comparison", "--budget", "huge"},
           {"reproduce", "van-der-pol-comparison", "--seeds", "0"}}) {
    EXPECT_EQ(RunMetaekf(arguments).status, 2) << ::testing::PrintToString(arguments);
  }
}

TEST(ReproduceTest, ARecordingThatIsNotThereIsNamed) {
  const Outcome outcome = RunMetaekf({"reproduce", "van-der-pol-comparison", "--data", "/no/such.csv"});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, HasSubstr("/no/such.csv"));
}

}  // namespace
}  // namespace metaekf::testing
