#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "absl/strings/str_cat.h"
#include "tests/client/fake_server.h"
#include "tests/client/run.h"

/// `metaekf train` and `metaekf jobs`.
namespace metaekf::testing {
namespace {

using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

class TrainTest : public ::testing::Test {
 protected:
  Outcome Run(std::vector<std::string> arguments) {
    arguments.insert(arguments.end(), {"--server", server_.address()});
    return RunMetaekf(arguments);
  }
  const std::string spec_ = TempFile("spec.textproto", "model { case: INPUT_OUTPUT }\n");
  const std::string data_ =
      TempFile("fleet.csv", "trajectory,t,u1,y1\na,0,1,2\na,0.5,3,4\nb,0,5,6\nb,0.5,7,8\n");
  FakeServer server_;
};

TEST_F(TrainTest, SendsTheFleetAndPrintsTheJob) {
  const Outcome outcome =
      Run({"train", "--name", "vdp", "--spec", spec_, "--data", data_, "--output", "json"});
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(server_.training.header.model(), "models/vdp");
  EXPECT_EQ(server_.training.header.spec().model().case_(), v1::ModelSpec::INPUT_OUTPUT);
  EXPECT_EQ(server_.training.header.channels().outputs(0).name(), "y1");
  ASSERT_EQ(server_.training.messages.size(), 2U);
  EXPECT_EQ(server_.training.messages[1].trajectory(), "b");
  EXPECT_EQ(server_.training.messages[1].sample_period_s(), 0.5);
  EXPECT_THAT(server_.training.messages[1].outputs(), ElementsAre(6, 8));
  EXPECT_EQ(nlohmann::json::parse(outcome.out)["id"], "7");
  EXPECT_THAT(outcome.err, HasSubstr("metaekf jobs watch 7"));
}

TEST_F(TrainTest, WatchingEndsWithTheModelThatWasMade) {
  const Outcome outcome = Run(
      {"train", "--name", "vdp", "--spec", spec_, "--data", data_, "--watch", "--output", "json"});
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const auto json = nlohmann::json::parse(outcome.out);
  EXPECT_EQ(json["state"], "succeeded");
  EXPECT_EQ(json["model"], "vdp@3");
}

std::string Rows(int trajectories, int length) {
  std::string rows = "trajectory,t,u1,y1\n";
  for (int s = 0; s < trajectories; ++s) {
    for (int t = 0; t < length; ++t) {
      absl::StrAppend(&rows, s, ",", t, ",", (t * 7 + s) % 5, ",", (t * 3 + s) % 4, "\n");
    }
  }
  return rows;
}

TEST_F(TrainTest, ADryRunEstimatesWithoutAServer) {
  const std::string transition = "transition { block { hidden_widths: 3 } bypass: LINEAR input_time: NEXT }";
  const std::string gradients = absl::StrCat("model { case: INPUT_OUTPUT latent_size: 2 window: 4 ", transition,
                                             " } context_samples: 20 target_samples: 20 iterations: ");
  const std::string fits = absl::StrCat("model { case: INPUT_OUTPUT latent_size: 2 window: 4 start: FITTED precision: FLOAT64 ",
                                        transition, " } loss { whole_set_horizon: true } algorithm: GAUSSIAN_PRIOR");
  const std::string data = TempFile("rows.csv", Rows(5, 150));
  const auto seconds = [&](const std::string& spec) {
    const Outcome outcome = RunMetaekf({"train", "--name", "m", "--spec", TempFile("dry.textproto", spec), "--data", data,
                                        "--dry-run", "--output", "json"});
    EXPECT_EQ(outcome.status, 0) << outcome.err;
    const auto json = nlohmann::json::parse(outcome.out);
    EXPECT_GT(json["estimated_memory_mib"], 1);
    return json["estimated_duration_s"].get<double>();
  };
  EXPECT_GT(seconds(fits), 0);
  EXPECT_GT(seconds(gradients + "1000 warmup_iterations: 100 horizon_growth_iterations: 500"), 0);
  // A thousand times the steps: about as many times the duration.
  EXPECT_GT(seconds(gradients + "1000000"), 20 * seconds(gradients + "1000"));
}

TEST_F(TrainTest, ADryRunNamesWhatIsWrong) {
  const Outcome outcome = RunMetaekf({"train", "--name", "m", "--spec", spec_, "--data", data_, "--dry-run"});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, HasSubstr("model.latent_size"));
}

TEST_F(TrainTest, AJobThatFailsIsAFailure) {
  server_.training.end_state = v1::Job::FAILED;
  const Outcome outcome = Run({"jobs", "watch", "7"});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.out, HasSubstr("failed"));
  EXPECT_THAT(outcome.err, HasSubstr("job 7 failed: the loss diverged"));
}

TEST_F(TrainTest, AMistakeInTheSpecIsNamedWithItsPlace) {
  const std::string wrong = TempFile("wrong.textproto", "model {\n  latent: 3\n}\n");
  const Outcome outcome = Run({"train", "--name", "vdp", "--spec", wrong, "--data", data_});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, AllOf(HasSubstr(wrong + ":2:"), HasSubstr("latent_size")));
}

TEST_F(TrainTest, AMissingValueInTheFleetIsNamedWithItsPlace) {
  const std::string gap = TempFile("gap.csv", "u1,y1\n1,2\n3,\n");
  const Outcome outcome = Run({"train", "--name", "vdp", "--spec", spec_, "--data", gap});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, AllOf(HasSubstr("gap.csv"), HasSubstr("3"), HasSubstr("y1")));
}

TEST_F(TrainTest, JobsAreListedShownAndCancelled) {
  EXPECT_EQ(Run({"jobs", "list", "--output", "csv"}).out,
            "id,model,state,iteration,iterations,best_validation_loss,create_time\n"
            "7,vdp,queued,0,0,,\n");
  EXPECT_THAT(Run({"jobs", "show", "7"}).out, HasSubstr("queued"));
  EXPECT_THAT(Run({"jobs", "cancel", "7"}).out, HasSubstr("cancelled"));
  const Outcome unknown = Run({"jobs", "show", "8"});
  EXPECT_EQ(unknown.status, 1);
  EXPECT_THAT(unknown.err, HasSubstr("metaekf jobs list"));
}

}  // namespace
}  // namespace metaekf::testing
