#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/client/run.h"

/// Wrong usage, and what holds for every command: client/cli/app.h and console.h.
namespace metaekf::testing {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::StartsWith;

/// One line, so that it can be read in a log.
void ExpectOneLine(const std::string& text) { EXPECT_EQ(text.find('\n'), text.size() - 1) << text; }

TEST(UsageTest, HelpOfEverySubcommandEndsWithZero) {
  for (const char* command : {"doctor",
                              "simulate",
                              "train",
                              "jobs",
                              "jobs list",
                              "jobs show",
                              "jobs watch",
                              "jobs cancel",
                              "models",
                              "models list",
                              "models show",
                              "models export",
                              "models import",
                              "models alias",
                              "models delete",
                              "adapt",
                              "adaptations",
                              "adaptations list",
                              "adaptations show",
                              "adaptations delete",
                              "predict",
                              "estimate",
                              "compare",
                              "reproduce"}) {
    std::istringstream words(command);
    std::vector<std::string> arguments{std::istream_iterator<std::string>(words), {}};
    arguments.push_back("--help");
    const Outcome outcome = RunMetaekf(arguments);
    EXPECT_EQ(outcome.status, 0) << command;
    EXPECT_THAT(outcome.out, HasSubstr("Usage: metaekf " + std::string(command)));
    EXPECT_EQ(outcome.err, "");
  }
}

TEST(UsageTest, AnUnknownSubcommandIsNamedWithThoseThatExist) {
  Outcome outcome = RunMetaekf({"trian"});
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err, AllOf(HasSubstr("unknown subcommand \"trian\""), HasSubstr("train")));
  ExpectOneLine(outcome.err);
  outcome = RunMetaekf({"models", "lst"});
  EXPECT_EQ(outcome.status, 2);
  EXPECT_THAT(outcome.err,
              AllOf(HasSubstr("\"lst\""), HasSubstr("list"), HasSubstr("metaekf models --help")));
}

TEST(UsageTest, WrongUsageEndsWithTwoAndSaysWhereTheHelpIs) {
  const std::vector<std::vector<std::string>> wrong = {
      {},
      {"models"},
      {"train", "--name", "a"},
      {"models", "list", "--output", "xml"},
      {"models", "list", "--unknown"},
      {"predict", "--model", "a", "--data", "f", "--mode", "two-step"},
      {"predict", "--data", "f", "--mode", "simulate"},
      {"predict", "--model", "a", "--adaptation", "b", "--data", "f", "--mode", "simulate"},
      {"adapt", "--model", "a", "--context", "f", "--samples", "0"},
      {"adapt", "--model", "a", "--context", "f", "--method", "magic"},
      {"models", "delete", "a"},
      {"compare", "--data", "f"}};
  for (const auto& arguments : wrong) {
    const Outcome outcome = RunMetaekf(arguments);
    EXPECT_EQ(outcome.status, 2) << ::testing::PrintToString(arguments);
    EXPECT_THAT(outcome.err, AllOf(StartsWith("metaekf: "), HasSubstr("--help")));
    ExpectOneLine(outcome.err);
    EXPECT_EQ(outcome.out, "");
  }
}

TEST(UsageTest, WithoutAServerOneLineSaysSoAndHowToStartOne) {
  // Port 1 is reserved and nobody listens there.
  for (const auto& arguments : std::vector<std::vector<std::string>>{
           {"models", "list", "--server", "127.0.0.1:1"},
           {"--server", "127.0.0.1:1", "jobs", "list"},
           {"estimate", "--server", "127.0.0.1:1", "--model", "a"}}) {
    const Outcome outcome = RunMetaekf(arguments);
    EXPECT_EQ(outcome.status, 1);
    EXPECT_EQ(outcome.out, "");
    EXPECT_EQ(outcome.err,
              "metaekf: no server at 127.0.0.1:1; start one with: metaekfd --data-dir DIR "
              "--listen 127.0.0.1:1\n");
  }
}

TEST(UsageTest, TheServerMayComeFromTheEnvironment) {
  setenv("METAEKF_SERVER", "127.0.0.1:2", 1);
  EXPECT_THAT(RunMetaekf({"models", "list"}).err, HasSubstr("no server at 127.0.0.1:2;"));
  EXPECT_THAT(RunMetaekf({"models", "list", "--server", "127.0.0.1:1"}).err,
              HasSubstr("no server at 127.0.0.1:1;"));
  unsetenv("METAEKF_SERVER");
}

TEST(UsageTest, FilesThatCannotBeReadAreNamed) {
  const Outcome outcome =
      RunMetaekf({"train", "--name", "a", "--spec", "/no/such.textproto", "--data", "x.csv"});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, AllOf(HasSubstr("/no/such.textproto"), HasSubstr("No such file")));
}

}  // namespace
}  // namespace metaekf::testing
