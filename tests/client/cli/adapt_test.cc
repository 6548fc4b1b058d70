#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "tests/client/fake_server.h"
#include "tests/client/run.h"

/// `metaekf adapt` and `metaekf adaptations`.
namespace metaekf::testing {
namespace {

using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

class AdaptTest : public ::testing::Test {
 protected:
  Outcome Run(std::vector<std::string> arguments) {
    arguments.insert(arguments.end(), {"--server", server_.address()});
    return RunMetaekf(arguments);
  }
  Outcome Adapt(std::vector<std::string> arguments) {
    arguments.insert(arguments.begin(), {"adapt", "--model", "vdp", "--context", context_});
    return Run(arguments);
  }
  const std::string context_ = TempFile("context.csv", "u1,y1\n1,10\n2,20\n3,30\n4,40\n5,50\n");
  FakeServer server_;
};

TEST_F(AdaptTest, SendsWhatIsAskedFor) {
  const Outcome outcome =
      Adapt({"--samples", "4", "--name", "new", "--method", "from-scratch", "--inner-steps", "20",
             "--inner-lr", "0.5", "--adapt", "encoder.*", "--seed", "3"});
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const auto& options = server_.adaptations.options;
  EXPECT_EQ(options.model(), "models/vdp");
  EXPECT_EQ(options.adaptation_id(), "new");
  EXPECT_EQ(options.method(), v1::Adaptation::FROM_SCRATCH);
  EXPECT_EQ(options.inner_loop().steps(), 20U);
  EXPECT_EQ(options.inner_loop().learning_rate(), 0.5);
  EXPECT_EQ(options.inner_loop().adapted_mask(), "encoder.*");
  EXPECT_EQ(options.seed(), 3U);
  EXPECT_THAT(server_.adaptations.context.outputs(), ElementsAre(10, 20, 30, 40));
}

TEST_F(AdaptTest, LeavesToTheModelWhatIsNotSaid) {
  ASSERT_EQ(Adapt({}).status, 0);
  const auto& options = server_.adaptations.options;
  EXPECT_EQ(options.method(), v1::Adaptation::METHOD_UNSPECIFIED);
  EXPECT_FALSE(options.inner_loop().has_steps());
  EXPECT_FALSE(options.inner_loop().has_learning_rate());
}

TEST_F(AdaptTest, TheReceiptComparesWithTheUnadaptedModelAndArx) {
  const Outcome table = Adapt({});
  EXPECT_THAT(table.out, AllOf(HasSubstr("vdp@2"), HasSubstr("simulate_arx"), HasSubstr("0.0625"),
                               HasSubstr("beats both the unadapted one and linear ARX")));
  const auto json = nlohmann::json::parse(Adapt({"--output", "json"}).out);
  EXPECT_EQ(json["held_out_rmse"][0]["unit"], "m");
  EXPECT_EQ(json["held_out_rmse"][0]["one_step_before"], 0.5);
  EXPECT_EQ(json["held_out_rmse"][0]["simulate_after"], 0.25);
  EXPECT_EQ(Adapt({"--output", "csv"}).out,
            "output,unit,one_step_before,one_step_after,one_step_arx,simulate_before,"
            "simulate_after,simulate_arx\n"
            "y1,m,0.5,0.125,0.0625,0.75,0.25,0.5\n");
}

TEST_F(AdaptTest, AModelThatBeatsNothingIsCalledSo) {
  auto* held_out = server_.adaptations.adaptation.mutable_held_out();
  held_out->set_better_than_unadapted(false);
  held_out->set_better_than_arx(false);
  EXPECT_THAT(Adapt({}).out, HasSubstr("beats neither the unadapted one nor linear ARX"));
  held_out->set_better_than_unadapted(true);
  EXPECT_THAT(Adapt({}).out, HasSubstr("but not linear ARX"));
  held_out->set_better_than_unadapted(false);
  held_out->set_better_than_arx(true);
  EXPECT_THAT(Adapt({}).out, HasSubstr("but not the unadapted one"));
  server_.adaptations.adaptation.clear_held_out();
  EXPECT_THAT(Adapt({}).out, HasSubstr("too short to hold a tail out"));
}

TEST_F(AdaptTest, MethodAndRequirementAreSent) {
  EXPECT_EQ(Adapt({"--method", "map", "--require-better-than-arx"}).status, 0);
  EXPECT_EQ(server_.adaptations.options.method(), v1::Adaptation::LEVENBERG_MARQUARDT);
  EXPECT_TRUE(server_.adaptations.options.require_better_than_arx());
}

TEST_F(AdaptTest, AShortContextIsAnsweredWithTheSamplesNeeded) {
  const Outcome outcome = Adapt({"--samples", "2"});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_EQ(outcome.out, "");
  EXPECT_THAT(outcome.err, HasSubstr("needs 4"));
}

TEST_F(AdaptTest, WrongContextsAreRefusedBeforeTheyAreSent) {
  EXPECT_THAT(Adapt({"--samples", "9"}).err, HasSubstr("has 5"));
  EXPECT_THAT(Run({"adapt", "--model", "vdp", "--context", "/no/such.csv"}).err,
              HasSubstr("/no/such.csv"));
  const std::string other = TempFile("other.csv", "force,disp\n1,2\n");
  EXPECT_THAT(Run({"adapt", "--model", "vdp", "--context", other}).err,
              AllOf(HasSubstr("no column \"u1\""), HasSubstr("--inputs")));
  const std::string two = TempFile("two.csv", "trajectory,u1,y1\na,1,2\nb,1,2\n");
  EXPECT_THAT(Run({"adapt", "--model", "vdp", "--context", two}).err, HasSubstr("2 trajectories"));
  EXPECT_EQ(server_.adaptations.context.sample_count(), 0U);
}

TEST_F(AdaptTest, ColumnsAreMapped) {
  const std::string other = TempFile("other.csv", "force,disp\n1,2\n1,3\n1,4\n1,5\n");
  ASSERT_EQ(Run({"adapt", "--model", "vdp", "--context", other, "--inputs", "force", "--outputs",
                 "disp", "--sample-period-s", "0.25"})
                .status,
            0);
  EXPECT_THAT(server_.adaptations.context.outputs(), ElementsAre(2, 3, 4, 5));
  EXPECT_EQ(server_.adaptations.context.sample_period_s(), 0.25);
}

TEST_F(AdaptTest, AdaptationsAreListedShownAndDeleted) {
  EXPECT_THAT(Run({"adaptations", "list"}).out, AllOf(HasSubstr("new"), HasSubstr("vdp@2")));
  EXPECT_THAT(Run({"adaptations", "show", "new"}).out, HasSubstr("beats both"));
  ASSERT_EQ(Run({"adaptations", "delete", "new"}).status, 0);
  EXPECT_EQ(server_.adaptations.deleted, "adaptations/new");
  const Outcome unknown = Run({"adaptations", "show", "old"});
  EXPECT_EQ(unknown.status, 1);
  EXPECT_THAT(unknown.err, HasSubstr("metaekf adaptations list"));
}

}  // namespace
}  // namespace metaekf::testing
