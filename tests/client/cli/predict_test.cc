#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <nlohmann/json.hpp>

#include "tests/client/fake_server.h"
#include "tests/client/run.h"

/// `metaekf predict` and `metaekf compare`.
namespace metaekf::testing {
namespace {

using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

class PredictTest : public ::testing::Test {
 protected:
  Outcome Run(std::vector<std::string> arguments) {
    arguments.insert(arguments.end(), {"--server", server_.address()});
    return RunMetaekf(arguments);
  }
  Outcome Predict(std::vector<std::string> arguments) {
    arguments.insert(arguments.begin(), {"predict", "--model", "vdp", "--data", data_, "--mode"});
    return Run(arguments);
  }
  const std::string data_ =
      TempFile("data.csv", "trajectory,u1,y1\na,0,1\na,0,2\na,0,4\nb,0,8\nb,0,9\n");
  // One step ahead the fake predicts y_{t−1}: errors 1, 2 and 1 at y = 2, 4 and 9, of mean 5.
  const double rmse_ = std::sqrt(6.0 / 3);
  const double fit_ = 100 * (1 - std::sqrt(6.0 / (9 + 1 + 16)));
  FakeServer server_;
};

TEST_F(PredictTest, PrintsPredictionsAsCsv) {
  // The period is the model's, 0.5 s; the warm-up has no prediction.
  const char* expected =
      "trajectory,t,y1,y1_hat\n"
      "a,0,1,\n"
      "a,0.5,2,1\n"
      "a,1,4,2\n"
      "b,0,8,\n"
      "b,0.5,9,8\n";
  const Outcome outcome = Predict({"one-step"});
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.out, expected);
  EXPECT_EQ(Predict({"one-step", "--output", "csv"}).out, expected);
}

TEST_F(PredictTest, PrintsFiguresAsJson) {
  const std::string out = TempPath("out.csv");
  const auto json =
      nlohmann::json::parse(Predict({"one-step", "--output", "json", "--out", out}).out);
  EXPECT_DOUBLE_EQ(json["rmse"]["y1"].get<double>(), rmse_);
  EXPECT_DOUBLE_EQ(json["fit_percent"]["y1"].get<double>(), fit_);
  EXPECT_EQ(json["samples"], 3);
  EXPECT_EQ(json["mode"], "one-step");
  EXPECT_EQ(json["warmup"], 1);
  EXPECT_THAT(Contents(out), HasSubstr("a,0.5,2,1\n"));
}

TEST_F(PredictTest, PrintsFiguresAsATableBesideAFile) {
  const Outcome outcome = Predict({"simulate", "--out", TempPath("out.csv")});
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  // Free run: y_0, errors 1, 3 and 1; √(11/3) = 1.915.
  EXPECT_THAT(outcome.out, AllOf(HasSubstr("rmse"), HasSubstr("1.915"), HasSubstr("simulate")));
}

TEST_F(PredictTest, PlotsTruthAgainstPrediction) {
  const std::string plot = TempPath("plot.svg");
  ASSERT_EQ(Predict({"one-step", "--plot", plot}).status, 0);
  EXPECT_THAT(Contents(plot), AllOf(HasSubstr("<svg"), HasSubstr("y1 (m)"), HasSubstr("measured"),
                                    HasSubstr("predicted")));
}

TEST_F(PredictTest, AFreeRunMayLackOutputsButOneStepMayNot) {
  const std::string gap = TempFile("gap.csv", "u1,y1\n0,1\n0,\n0,3\n");
  EXPECT_EQ(Run({"predict", "--model", "vdp", "--data", gap, "--mode", "simulate"}).out,
            "trajectory,t,y1,y1_hat\n0,0,1,\n0,0.5,,1\n0,1,3,1\n");
  const Outcome outcome = Run({"predict", "--model", "vdp", "--data", gap, "--mode", "one-step"});
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, AllOf(HasSubstr("gap.csv"), HasSubstr("missing")));
}

TEST_F(PredictTest, StatesAreSentAndPrintedInCaseTwo) {
  server_.models.version.mutable_spec()->mutable_model()->set_case_(
      v1::ModelSpec::STATE_INPUT_OUTPUT);
  server_.models.version.mutable_channels()->add_states()->set_name("x1");
  EXPECT_THAT(Predict({"simulate"}).err, HasSubstr("no column \"x1\""));
  const std::string data = TempFile("x.csv", "u1,y1,x1\n0,1,5\n0,2,6\n");
  EXPECT_EQ(Run({"predict", "--model", "vdp", "--data", data, "--mode", "one-step"}).out,
            "trajectory,t,y1,y1_hat,x1,x1_hat\n0,0,1,,5,5\n0,0.5,2,1,6,6\n");
}

TEST_F(PredictTest, AnAdaptationPredictsLikeAModel) {
  ASSERT_EQ(Run({"predict", "--adaptation", "new", "--data", data_, "--mode", "one-step"}).status,
            0);
  EXPECT_EQ(server_.predictions.header.target(), "adaptations/new");
  EXPECT_EQ(server_.models.asked_version, "models/vdp/versions/2");
}

TEST_F(PredictTest, CompareSetsModelsBesideArxOnTheSameSamples) {
  // y_t = 0.5 y_{t−1} + u_t exactly, which ARX(1) must find.
  std::string text = "u1,y1\n";
  double y = 0, u = 1;
  for (int t = 0; t < 40; ++t) {
    u = u * 5 - 3 * static_cast<int>(u * 5 / 3);  // wanders over [0, 3)
    y = 0.5 * y + u;
    text += std::to_string(u) + "," + std::to_string(y) + "\n";
  }
  const std::string data = TempFile("arx.csv", text);
  const Outcome outcome =
      Run({"compare", "--data", data, "--model", "vdp", "--adaptation", "new", "--arx", data,
           "--arx-samples", "30", "--arx-order", "3", "--output", "json"});
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const auto rows = nlohmann::json::parse(outcome.out);
  ASSERT_EQ(rows.size(), 3U);
  EXPECT_EQ(rows[0]["model"], "vdp");
  EXPECT_EQ(rows[1]["model"], "new");
  EXPECT_EQ(rows[2]["model"], "ARX(3)");
  EXPECT_EQ(rows[2]["unit"], "m");
  for (const auto& row : rows) EXPECT_EQ(row["samples"], 40 - 3);
  // The file has six digits.
  EXPECT_LT(rows[2]["simulate_rmse"].get<double>(), 1e-5);
  EXPECT_GT(rows[0]["one_step_rmse"].get<double>(), 0.1);
}

}  // namespace
}  // namespace metaekf::testing
