#include "client/cli/progress.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <sstream>

namespace metaekf::cli {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::Not;
using ::testing::StartsWith;

TEST(ProgressTest, DurationsAreForPeople) {
  EXPECT_EQ(FormatDuration(42.4), "42 s");
  EXPECT_EQ(FormatDuration(185), "3 min 5 s");
  EXPECT_EQ(FormatDuration(7800), "2 h 10 min");
}

TEST(ProgressTest, ABarIsDrawnAndClearedOnATerminal) {
  std::istringstream in;
  std::ostringstream out, err;
  Console console(in, out, err, true);
  {
    Progress bar(console, "training");
    bar.Update(1, 2, 65, "loss 0.5");
  }
  EXPECT_THAT(err.str(), AllOf(HasSubstr("training [###############...............] 1/2"),
                               HasSubstr("1 min 5 s left, loss 0.5")));
  EXPECT_TRUE(err.str().ends_with("\r\x1b[K"));
  EXPECT_EQ(out.str(), "");
}

TEST(ProgressTest, OneReportAloneTellsNoPace) {
  std::istringstream in;
  std::ostringstream out, err;
  Console console(in, out, err, true);
  Progress bar(console, "adapting");
  bar.Update(1, 60, {}, "");
  EXPECT_THAT(err.str(), AllOf(HasSubstr("1/60"), Not(HasSubstr("left"))));
}

TEST(ProgressTest, OtherWorkHasAPaceOfItsOwn) {
  std::istringstream in;
  std::ostringstream out, err;
  Console console(in, out, err, true);
  Progress bar(console, "studying");
  bar.Update(0, 8, {}, "training");
  bar.Update(1, 120, {}, "adapting");  // the first of its kind: how long it took is not known
  EXPECT_THAT(err.str(), AllOf(HasSubstr("1/120"), Not(HasSubstr("left"))));
}

TEST(ProgressTest, WorkThatBeginsAgainHasANewPace) {
  std::istringstream in;
  std::ostringstream out, err;
  Console console(in, out, err, true);
  Progress bar(console, "studying");
  bar.Update(1, 100, {}, "training MAML");
  bar.Update(60, 100, {}, "training MAML");
  err.str("");
  bar.Update(1, 100, {}, "training Reptile");
  EXPECT_THAT(err.str(), AllOf(HasSubstr("1/100, training Reptile"), Not(HasSubstr("left"))));
}

TEST(ProgressTest, ElsewhereThereIsNoBar) {
  std::istringstream in;
  std::ostringstream out, err;
  Console console(in, out, err, false);
  Progress bar(console, "training");
  for (uint64_t i = 1; i <= 100; ++i) bar.Update(i, 100, {}, "");
  // Ten seconds have not passed.
  EXPECT_EQ(err.str(), "");
}

}  // namespace
}  // namespace metaekf::cli
