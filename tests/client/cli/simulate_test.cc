#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "core/data/csv.h"
#include "tests/client/run.h"

namespace metaekf::testing {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;

TEST(SimulateTest, WritesAFleetThatReadsBack) {
  const std::string out = TempPath("fleet.csv");
  const Outcome outcome = RunMetaekf(
      {"simulate", "van-der-pol", "--systems", "3", "--seed", "5", "--steps", "20", "--out", out});
  EXPECT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.out, "");
  const auto fleet = data::ReadCsvFile(out);
  ASSERT_TRUE(fleet.ok()) << fleet.status();
  EXPECT_EQ(fleet->trajectories.size(), 3U);
  EXPECT_EQ(fleet->trajectories[2].length(), 20);
}

TEST(SimulateTest, SettingsStandBeforeOrBehindTheSystem) {
  const std::string out = TempPath("one.csv");
  ASSERT_EQ(RunMetaekf({"simulate", "--set", "theta=1", "--set", "x1_0=0.5", "van-der-pol", "--set",
                        "x2_0=0", "--steps", "2", "--out", out})
                .status,
            0);
  // By hand: x1⁺ = 0.5, x2⁺ = 0 + 0.01 (1 · 0 · (1 − 0.25) − 0.5) = −0.005.
  const auto fleet = data::ReadCsvFile(out);
  EXPECT_EQ(fleet->trajectories[0].states(0, 1), 0.5);
  EXPECT_DOUBLE_EQ(fleet->trajectories[0].states(1, 1), -0.005);
}

TEST(SimulateTest, ParametersComeFromAFileAndGoToOne) {
  const std::string parameters = TempFile("in.csv", "theta\n0.75\n1.25\n");
  const std::string used = TempPath("used.csv");
  ASSERT_EQ(RunMetaekf({"simulate", "van-der-pol", "--systems", "2", "--params", parameters,
                        "--steps", "2", "--out", TempPath("fleet.csv"), "--params-out", used})
                .status,
            0);
  const auto table = data::ReadTableFile(used);
  ASSERT_TRUE(table.ok()) << table.status();
  EXPECT_EQ(table->names[0], "theta");
  EXPECT_EQ(table->values(1, 0), 1.25);
}

TEST(SimulateTest, TakesARecordedInput) {
  std::string record = "force,other\n";
  for (int i = 0; i < 16; ++i) record += i % 2 == 0 ? "10,1\n" : "-10,1\n";
  const std::string out = TempPath("out.csv");
  const Outcome outcome = RunMetaekf({"simulate", "bouc-wen", "--input", TempFile("in.csv", record),
                                      "--inputs", "force", "--hold", "linear", "--out", out});
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const auto fleet = data::ReadCsvFile(out);
  EXPECT_EQ(fleet->trajectories[0].length(), 16);
  EXPECT_EQ(fleet->trajectories[0].inputs(0, 1), -10);
}

TEST(SimulateTest, TheHelpOfASystemListsItsParametersAndOptions) {
  const Outcome outcome = RunMetaekf({"simulate", "bouc-wen", "--help"});
  EXPECT_EQ(outcome.status, 0);
  EXPECT_THAT(outcome.out, AllOf(HasSubstr("Usage: metaekf simulate"),
                                 HasSubstr("m_L  1 to 3 kg, nominal 2  mass"),
                                 HasSubstr("excitation  multisine|sine, default multisine"),
                                 HasSubstr("band_min  0 to 375, default 5 Hz")));
}

TEST(SimulateTest, MistakesAreAnsweredWithWhatThereIs) {
  const std::string out = TempPath("out.csv");
  const auto error = [&](std::vector<std::string> arguments, int status) {
    arguments.insert(arguments.begin(), "simulate");
    const Outcome outcome = RunMetaekf(arguments);
    EXPECT_EQ(outcome.status, status) << ::testing::PrintToString(arguments);
    return outcome.err;
  };
  EXPECT_THAT(error({"--out", out}, 2), HasSubstr("van-der-pol"));
  EXPECT_THAT(error({"vanderpol", "--out", out}, 2), HasSubstr("van-der-pol"));
  EXPECT_THAT(error({"vanderpol", "--help"}, 2), HasSubstr("van-der-pol"));
  EXPECT_THAT(error({"van-der-pol"}, 2), HasSubstr("--out FILE"));
  EXPECT_THAT(error({"van-der-pol", "--out", out, "--set", "mu=1"}, 2), HasSubstr("theta"));
  EXPECT_THAT(error({"van-der-pol", "--out", out, "--set", "theta"}, 2), HasSubstr("theta"));
  EXPECT_THAT(error({"van-der-pol", "--out", "/no/dir/x.csv", "--steps", "2"}, 1),
              HasSubstr("/no/dir/x.csv"));
  EXPECT_THAT(error({"bouc-wen", "--out", out, "--input", TempFile("i.csv", "u1\n1\n2\n"), "--hold",
                     "cubic"},
                    2),
              HasSubstr("band-limited"));
}

}  // namespace
}  // namespace metaekf::testing
