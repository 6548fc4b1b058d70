#include "client/src/text_proto.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "metaekf/v1/spec.pb.h"

namespace metaekf::client {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::StartsWith;

TEST(TextProtoTest, ReadsWhatItPrints) {
  v1::TrainingSpec spec, again;
  ASSERT_TRUE(ParseText("model { case: INPUT_OUTPUT latent_size: 4 }", "spec", &spec).ok());
  EXPECT_EQ(spec.model().latent_size(), 4U);
  ASSERT_TRUE(ParseText(PrintText(spec), "spec", &again).ok());
  EXPECT_EQ(again.model().case_(), v1::ModelSpec::INPUT_OUTPUT);
}

TEST(TextProtoTest, AnUnknownFieldIsNamedWithItsPlaceAndTheFieldsThatExist) {
  v1::TrainingSpec spec;
  const Status status =
      ParseText("loss { horizon: 2 }\nmodel {\n  windw: 3\n}\n", "a.textproto", &spec);
  EXPECT_EQ(status.code, Code::kInvalidArgument);
  // Protobuf reports the place behind the name; line 3 is where it stands.
  EXPECT_THAT(status.message,
              AllOf(StartsWith("a.textproto:3:"), HasSubstr("\"windw\""), HasSubstr(" window, ")));
}

TEST(TextProtoTest, AWrongValueIsNamedWithItsPlace) {
  v1::TrainingSpec spec;
  EXPECT_THAT(ParseText("iterations: many", "s", &spec).message,
              AllOf(StartsWith("s:1:13: "), HasSubstr("many")));
  EXPECT_THAT(ParseText("model { case: CASE_3 }", "s", &spec).message,
              AllOf(StartsWith("s:1:"), HasSubstr("CASE_3"), HasSubstr("case")));
}

}  // namespace
}  // namespace metaekf::client
