#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "tests/client/fake_server.h"
#include "tests/client/run.h"

/// `metaekf models` and `metaekf doctor`.
namespace metaekf::testing {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;

class ModelsTest : public ::testing::Test {
 protected:
  Outcome Run(std::vector<std::string> arguments) {
    arguments.insert(arguments.end(), {"--server", server_.address()});
    return RunMetaekf(arguments);
  }
  FakeServer server_;
};

TEST_F(ModelsTest, AreListed) {
  EXPECT_EQ(Run({"models", "list", "--output", "csv"}).out,
            "name,latest_version,versions,aliases,create_time\n"
            "vdp,2,2,stable=1,\n"
            "second,0,0,,\n");
}

TEST_F(ModelsTest, AreShownWithTheirSpecification) {
  const Outcome outcome = Run({"models", "show", "vdp@2", "--output", "json"});
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const auto json = nlohmann::json::parse(outcome.out);
  EXPECT_EQ(json["model"], "vdp@2");
  EXPECT_EQ(json["outputs"], "y1 (m)");
  EXPECT_EQ(json["estimates"], "outputs");
  EXPECT_EQ(json["create_time"], "1970-01-02T00:00:00Z");
  EXPECT_THAT(json["spec"].get<std::string>(), HasSubstr("INPUT_OUTPUT"));
}

TEST_F(ModelsTest, AnUnknownModelIsAnsweredWithWhereToLook) {
  const Outcome outcome = Run({"models", "show", "vpd"});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, AllOf(HasSubstr("no model"), HasSubstr("; see: metaekf models list")));
}

TEST_F(ModelsTest, AWrongNameIsAnsweredWithTheRule) {
  EXPECT_THAT(Run({"models", "show", "Vdp"}).err, HasSubstr("NAME@VERSION"));
}

TEST_F(ModelsTest, FilesGoInAndComeOut) {
  const std::string in = TempFile("in.safetensors", std::string("weights\0\n\r", 10));
  const Outcome imported = Run({"models", "import", "vdp", in});
  ASSERT_EQ(imported.status, 0) << imported.err;
  EXPECT_THAT(imported.out, HasSubstr("vdp@2"));
  const std::string out = TempPath("out.safetensors");
  ASSERT_EQ(Run({"models", "export", "vdp@2", out}).status, 0);
  EXPECT_EQ(Contents(out), Contents(in));
  const Outcome missing = Run({"models", "import", "vdp", "/no/such.safetensors"});
  EXPECT_EQ(missing.status, 1);
  EXPECT_THAT(missing.err, HasSubstr("/no/such.safetensors"));
}

TEST_F(ModelsTest, AliasesAndVersionsAreSetAndDeleted) {
  ASSERT_EQ(Run({"models", "alias", "vdp", "best", "2"}).status, 0);
  EXPECT_EQ(server_.models.set_alias.name(), "models/vdp/aliases/best");
  ASSERT_EQ(Run({"models", "delete", "vdp@best"}).status, 0);
  EXPECT_EQ(server_.models.deleted, "models/vdp/aliases/best");
  ASSERT_EQ(Run({"models", "delete", "vdp@2"}).status, 0);
  EXPECT_EQ(server_.models.deleted, "models/vdp/versions/2");
}

TEST_F(ModelsTest, DoctorFindsAHealthyServerHealthy) {
  const Outcome outcome = Run({"doctor"});
  EXPECT_EQ(outcome.status, 0) << outcome.out;
  EXPECT_EQ(outcome.err, "");
}

TEST_F(ModelsTest, DoctorSaysWhatIsWrongAndWhatToDo) {
  server_.info.info.set_version("0.0.1");
  auto* data = server_.info.info.mutable_data_directory();
  data->set_model_count(0);
  data->set_free_disk_bytes(1000);
  data->add_problems("models/vdp/versions/1 is damaged");
  const Outcome outcome = Run({"doctor", "--output", "json"});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, HasSubstr("4 of the checks"));
  EXPECT_THAT(outcome.out, AllOf(HasSubstr("same version"), HasSubstr("make room"),
                                 HasSubstr("models/vdp/versions/1 is damaged"),
                                 HasSubstr("metaekf models import")));
  EXPECT_TRUE(nlohmann::json::parse(outcome.out).is_array());
}

TEST(DoctorTest, SaysThatThereIsNoServer) {
  const Outcome outcome = RunMetaekf({"doctor", "--server", "127.0.0.1:1"});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.out, HasSubstr("no server at 127.0.0.1:1"));
}

}  // namespace
}  // namespace metaekf::testing
