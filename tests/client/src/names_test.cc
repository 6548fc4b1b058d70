#include "client/src/names.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace metaekf::client {
namespace {

using ::testing::HasSubstr;

TEST(NamesTest, ModelsOfPeopleBecomeResourceNames) {
  // The three forms of model.proto.
  EXPECT_EQ(*ModelResource("van-der-pol"), "models/van-der-pol");
  EXPECT_EQ(*ModelResource("van-der-pol@3"), "models/van-der-pol/versions/3");
  EXPECT_EQ(*ModelResource("m_2@stable"), "models/m_2/aliases/stable");
  EXPECT_EQ(*ModelResource("models/m/versions/3"), "models/m/versions/3");
}

TEST(NamesTest, AWrongModelNameIsRefusedWithTheRule) {
  for (const char* name : {"", "Upper", "_m", "m@", "m@-1", "m@0", "m@3a", "m@_x", "a b"}) {
    const auto resource = ModelResource(name);
    ASSERT_FALSE(resource.ok()) << name;
    EXPECT_EQ(resource.status().code, Code::kInvalidArgument);
    EXPECT_THAT(resource.status().message, HasSubstr("NAME@VERSION"));
  }
  EXPECT_FALSE(ModelResource(std::string(64, 'a')).ok());
  EXPECT_TRUE(ModelResource(std::string(63, 'a')).ok());
}

TEST(NamesTest, WhereAModelIsMeantAVersionIsRefused) {
  EXPECT_EQ(*BareModelResource("m"), "models/m");
  EXPECT_THAT(BareModelResource("m@3").status().message, HasSubstr("name alone"));
}

TEST(NamesTest, IdsGetTheirCollection) {
  EXPECT_EQ(*Resource("jobs", "7"), "jobs/7");
  EXPECT_EQ(*Resource("jobs", "jobs/7"), "jobs/7");
  EXPECT_FALSE(Resource("jobs", "adaptations/7").ok());
}

TEST(NamesTest, ATargetIsAModelOrAnAdaptation) {
  EXPECT_EQ(*TargetResource({.model = "m@2"}), "models/m/versions/2");
  EXPECT_EQ(*TargetResource({.adaptation = "a"}), "adaptations/a");
  EXPECT_FALSE(TargetResource({}).ok());
  EXPECT_FALSE(TargetResource({.model = "m", .adaptation = "a"}).ok());
}

TEST(NamesTest, SegmentsOfResourceNames) {
  EXPECT_EQ(Segment("models/m/versions/12", 1), "m");
  EXPECT_EQ(Segment("models/m/versions/12", 3), "12");
  EXPECT_EQ(Segment("models/m", 2), "");
  EXPECT_EQ(VersionOf("models/m/versions/12"), 12U);
  EXPECT_EQ(VersionOf("models/m"), 0U);
}

}  // namespace
}  // namespace metaekf::client
