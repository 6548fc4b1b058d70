#include "client/cli/data_files.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/client/run.h"

namespace metaekf::cli {
namespace {

using metaekf::testing::TempFile;
using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

/// Input force, output disp; states pos, vel if `with_states`.
TargetModel Model(bool with_states) {
  TargetModel model{.label = "m"};
  model.version.channels = {{{"force", "N"}}, {{"disp", "m"}}, {{"pos", "m"}, {"vel", "m/s"}}};
  model.version.estimates_states = with_states;
  return model;
}

TEST(ModelColumnsTest, AreNamedLikeTheModelsChannels) {
  const auto columns = ModelColumns({.sample_period_s = 0.5}, Model(true), true);
  ASSERT_TRUE(columns.ok());
  EXPECT_THAT(*columns->inputs, ElementsAre("force"));
  EXPECT_THAT(*columns->outputs, ElementsAre("disp"));
  EXPECT_THAT(*columns->states, ElementsAre("pos", "vel"));
  EXPECT_EQ(columns->fallback_sample_period_s, 0.5);
  // States of a model that learns from outputs are not needed, nor where the caller wants none.
  EXPECT_THAT(*ModelColumns({}, Model(false), true)->states, IsEmpty());
  EXPECT_THAT(*ModelColumns({}, Model(true), false)->states, IsEmpty());
}

TEST(ModelColumnsTest, AreThoseOfTheFlagsIfThereAreAsMany) {
  EXPECT_THAT(*ModelColumns({.inputs = "F"}, Model(true), true)->inputs, ElementsAre("F"));
  const absl::Status status = ModelColumns({.states = "a"}, Model(true), true).status();
  EXPECT_TRUE(IsUsageError(status));
  EXPECT_THAT(std::string(status.message()),
              AllOf(HasSubstr("--states names 1"), HasSubstr("has 2: pos, vel")));
}

TEST(ReadDataTest, SeveralFilesMakeOneFleet) {
  const std::string a = TempFile("a.csv", "u1,y1\n1,2\n3,4\n");
  const std::string b = TempFile("b.csv", "trajectory,u1,y1\np,5,6\nq,7,8\n");
  const auto fleet = ReadData({a, b}, FreeColumns({.sample_period_s = 0.1}));
  ASSERT_TRUE(fleet.ok()) << fleet.status();
  ASSERT_EQ(fleet->trajectories.size(), 3U);
  EXPECT_EQ(fleet->trajectories[0].name, a + ":0");
  EXPECT_EQ(fleet->trajectories[2].name, b + ":q");
  EXPECT_EQ(fleet->trajectories[2].outputs(0, 0), 8);
  EXPECT_EQ(fleet->trajectories[1].sample_period_s, 0.1);
}

TEST(ReadDataTest, FilesWithOtherColumnsAreRefused) {
  const std::string a = TempFile("a.csv", "u1,y1\n1,2\n");
  const std::string b = TempFile("b.csv", "y1\n5\n");
  EXPECT_THAT(std::string(ReadData({a, b}, {}).status().message()),
              AllOf(HasSubstr("b.csv has inputs ()"), HasSubstr("a.csv has inputs (u1)")));
}

TEST(ReadDataTest, AMissingColumnIsNamedWithHowToMapColumns) {
  const std::string path = TempFile("a.csv", "time,disp\n1,2\n");
  const auto columns = ModelColumns({}, Model(false), true);
  EXPECT_THAT(std::string(ReadData({path}, *columns).status().message()),
              AllOf(HasSubstr("no column \"force\""), HasSubstr("time, disp"),
                    HasSubstr("--inputs, --outputs and --states")));
}

TEST(ToClientTest, MatricesAreFlattenedSampleBySample) {
  data::Trajectory trajectory{.name = "a", .start_s = 2, .sample_period_s = 0.5};
  trajectory.outputs = Eigen::Matrix<double, 2, 3>{{1, 2, 3}, {4, 5, 6}};
  const client::Trajectory flat = ToClient(trajectory);
  EXPECT_EQ(flat.samples, 3U);
  EXPECT_THAT(flat.outputs, ElementsAre(1, 4, 2, 5, 3, 6));
  EXPECT_THAT(flat.inputs, IsEmpty());
  EXPECT_EQ(flat.start_time_s, 2);
}

}  // namespace
}  // namespace metaekf::cli
