#include "server/names/resource_names.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace metaekf::server {
namespace {

using ::testing::HasSubstr;

TEST(ResourceNamesTest, TargetsAreToldApart) {
  Target target = ParseTarget("f", "models/robot").value();
  EXPECT_EQ(target.kind, Target::Kind::kLatest);
  EXPECT_EQ(target.model, "robot");
  target = ParseTarget("f", "models/robot/versions/12").value();
  EXPECT_EQ(target.kind, Target::Kind::kVersion);
  EXPECT_EQ(target.version, 12);
  target = ParseTarget("f", "models/robot/aliases/stable").value();
  EXPECT_EQ(target.kind, Target::Kind::kAlias);
  EXPECT_EQ(target.alias, "stable");
  target = ParseTarget("f", "adaptations/a1").value();
  EXPECT_EQ(target.kind, Target::Kind::kAdaptation);
  EXPECT_EQ(target.adaptation, "a1");
}

TEST(ResourceNamesTest, NamesAreReadAsTheyAreWritten) {
  EXPECT_EQ(ParseModelName("f", ModelName("m")).value(), "m");
  EXPECT_EQ(ParseVersionName("f", VersionName("m", 3)).value().version, 3);
  EXPECT_EQ(ParseAliasName("f", AliasName("m", "a")).value().alias, "a");
  EXPECT_EQ(ParseAdaptationName("f", AdaptationName("a")).value(), "a");
  EXPECT_EQ(ParseJobName("f", JobName(4)).value(), 4);
  EXPECT_EQ(ParseSessionName("f", SessionName(5)).value(), 5);
}

TEST(ResourceNamesTest, OtherFormsAreViolationsOfTheField) {
  for (const char* name :
       {"", "robot", "models/", "models", "models/robot/", "models/Robot", "models/robot/versions",
        "models/robot/versions/0", "models/robot/versions/01", "models/robot/versions/-1",
        "models/robot/versions/x", "models/robot/versions/99999999999999999999",
        "models/robot/aliases/1a", "models/robot/other/a", "models/robot/versions/1/more",
        "adaptations/", "adaptations/a/b", "jobs/1", "models/../versions/1"}) {
    const absl::Status status = ParseTarget("open.target", name).status();
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << name;
    EXPECT_THAT(std::string(status.message()), HasSubstr("open.target: ")) << name;
  }
  EXPECT_FALSE(ParseModelTarget("f", "adaptations/a1").ok());
  EXPECT_FALSE(ParseVersionName("f", "models/robot").ok());
  EXPECT_FALSE(ParseAliasName("f", "models/robot/versions/1").ok());
  EXPECT_FALSE(ParseModelName("f", "models/robot/versions/1").ok());
  EXPECT_FALSE(ParseJobName("f", "jobs/0").ok());
  EXPECT_FALSE(ParseJobName("f", "jobs/+1").ok());
  EXPECT_FALSE(ParseSessionName("f", "jobs/1").ok());
  EXPECT_FALSE(CheckId("f", "with space").ok());
  EXPECT_TRUE(CheckId("f", "fine-1").ok());
}

}  // namespace
}  // namespace metaekf::server
