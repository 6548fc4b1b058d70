#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>

#include "tests/client/fake_server.h"
#include "tests/client/run.h"

namespace metaekf::testing {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;

constexpr char kHeader[] = "t,y1_hat,sy1,nis,health,flags\n";

class EstimateTest : public ::testing::Test {
 protected:
  Outcome Run(std::vector<std::string> arguments, const std::string& input = "") {
    arguments.insert(arguments.begin(),
                     {"estimate", "--model", "vdp", "--server", server_.address()});
    return RunMetaekf(arguments, input);
  }
  FakeServer server_;
};

TEST_F(EstimateTest, StreamsStandardInputRowByRow) {
  const Outcome outcome = Run({}, "t,u1,y1\n1,0,10\n1.5,0,\n2,0,nan\n2.5,0,40\n");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  // The fake repeats y with variance 0.25 and NIS 1.5.
  EXPECT_EQ(outcome.out, std::string(kHeader) +
                             "1,10,0.5,1.5,consistent,\n"
                             "1.5,10,0.5,,consistent,missing\n"
                             "2,10,0.5,,consistent,missing\n"
                             "2.5,40,0.5,1.5,consistent,\n");
  EXPECT_EQ(server_.estimation.batches.size(), 4U);
  EXPECT_EQ(server_.estimation.open.covariance_format(), v1::OpenSession::DIAGONAL);
}

TEST_F(EstimateTest, AFileIsSentInBatchesAndItsEstimatesWritten) {
  std::string text = "u1,y1\n";
  for (int i = 0; i < 1000; ++i) text += "0," + std::to_string(i) + "\n";
  const std::string out = TempPath("out.csv");
  const Outcome outcome = Run({"--data", TempFile("in.csv", text), "--out", out});
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const std::string written = Contents(out);
  EXPECT_EQ(std::count(written.begin(), written.end(), '\n'), 1001);
  EXPECT_TRUE(written.ends_with("\n499.5,999,0.5,1.5,consistent,\n"));  // 999 periods of 0.5 s
  EXPECT_EQ(server_.estimation.batches.size(), 16U);                    // of 64 samples
  EXPECT_THAT(outcome.out, AllOf(HasSubstr("1000"), HasSubstr("consistent")));
}

TEST_F(EstimateTest, GateAndLagAreAskedFor) {
  const std::string late = "t,u1,y1\n0,0,1\n0.5,0,\n1,0,3\n0.5,0,2\n";
  EXPECT_THAT(Run({}, late).err, HasSubstr("standard input:5"));  // without a lag, time is even
  const Outcome outcome = Run({"--gate", "0.99", "--recover-after", "3", "--projection", "autoencoder", "--initial-samples", "12", "--stay-diverged", "--max-lag-s", "2"}, late);
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(server_.estimation.open.gate().probability(), 0.99);
  EXPECT_EQ(server_.estimation.open.gate().recover_after(), 3);
  EXPECT_FALSE(server_.estimation.open.gate().off());
  EXPECT_TRUE(server_.estimation.open.stay_diverged());
  EXPECT_EQ(server_.estimation.open.projection(), v1::AUTOENCODER);
  EXPECT_EQ(server_.estimation.open.initial_samples(), 12);
  EXPECT_EQ(server_.estimation.open.max_lag_s(), 2);
  EXPECT_EQ(server_.estimation.batches.back().times_s(0), 0.5);
  ASSERT_EQ(Run({"--gate", "0"}, late.substr(0, 20)).status, 0);
  EXPECT_TRUE(server_.estimation.open.gate().off());
  EXPECT_EQ(Run({"--gate", "1.5"}, late).status, 2);
}

TEST_F(EstimateTest, SmoothsAWholeFile) {
  const std::string data = TempFile("smooth.csv", "t,u1,y1\n0,0,1\n0.5,0,\n1,0,3\n");
  const Outcome outcome = Run({"--smooth", "--gate", "0.9", "--data", data});
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.out, std::string(kHeader) +
                             "0,1,0.5,1.5,consistent,\n"
                             "0.5,7,0.5,1.5,consistent,missing\n"
                             "1,3,0.5,1.5,consistent,\n");
  EXPECT_EQ(server_.smoothing.header.target(), "models/vdp");
  EXPECT_EQ(server_.smoothing.header.gate().probability(), 0.9);
  const Outcome to_files = Run({"--smooth", "--data", data, "--out", TempPath("s.csv"), "--plot", TempPath("s.svg")});
  ASSERT_EQ(to_files.status, 0) << to_files.err;
  EXPECT_EQ(Contents(TempPath("s.csv")), outcome.out);
  EXPECT_THAT(Contents(TempPath("s.svg")), HasSubstr("Smoothed"));
  EXPECT_THAT(to_files.out, HasSubstr("consistent"));

  EXPECT_EQ(Run({"--smooth"}, "u1,y1\n0,1\n").status, 2);
  const Outcome two = Run({"--smooth", "--data", TempFile("two.csv", "trajectory,u1,y1\na,0,1\nb,0,1\n")});
  EXPECT_EQ(two.status, 1);
  EXPECT_THAT(two.err, HasSubstr("holds 2 trajectories"));
}

TEST_F(EstimateTest, PlotsEstimatesWithTheirBandAndTheTruth) {
  const std::string plot = TempPath("plot.svg");
  ASSERT_EQ(Run({"--plot", plot}, "u1,y1\n0,1\n0,2\n0,3\n").status, 0);
  EXPECT_THAT(Contents(plot), AllOf(HasSubstr("±2σ"), HasSubstr("measured"), HasSubstr("y1 (m)")));

  server_.models.version.mutable_spec()->mutable_model()->set_case_(
      v1::ModelSpec::STATE_INPUT_OUTPUT);
  server_.estimation.estimated.set_name("x1");
  const Outcome outcome = Run({"--plot", plot}, "u1,y1,x1\n0,1,5\n0,2,6\n");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_THAT(outcome.out, HasSubstr("t,x1,sx1,nis,health,flags\n"));
  EXPECT_THAT(Contents(plot), AllOf(HasSubstr("recorded"), HasSubstr("x1 (m)")));
}

TEST_F(EstimateTest, NoiseComesFromAFile) {
  const std::string noise = TempFile("noise.textproto", "process_noise_cov: [2, 3]");
  ASSERT_EQ(Run({"--noise", noise}, "u1,y1\n0,1\n").status, 0);
  EXPECT_EQ(server_.estimation.open.noise().process_noise_cov(1), 3);
  const Outcome wrong = Run({"--noise", TempFile("wrong.textproto", "q: 1")}, "u1,y1\n0,1\n");
  EXPECT_EQ(wrong.status, 1);
  EXPECT_THAT(wrong.err, AllOf(HasSubstr("wrong.textproto:1:"), HasSubstr("initial_mean")));
}

TEST_F(EstimateTest, AWrongRowEndsTheStreamAfterTheRowsBeforeIt) {
  const Outcome outcome = Run({}, "u1,y1\n0,1\n0,many\n0,3\n");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_EQ(outcome.out, std::string(kHeader) + "0,1,0.5,1.5,consistent,\n");
  EXPECT_THAT(outcome.err, AllOf(HasSubstr("standard input:3"), HasSubstr("many")));
}

TEST_F(EstimateTest, OneFilterFollowsOneSystem) {
  const Outcome outcome = Run({}, "trajectory,u1,y1\na,0,1\nb,0,2\n");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_THAT(outcome.err, HasSubstr("trajectory \"b\""));
}

TEST_F(EstimateTest, MistakesInTheFileAreFoundBeforeASessionIsOpened) {
  EXPECT_THAT(Run({"--data", "/no/such.csv"}).err, HasSubstr("/no/such.csv"));
  EXPECT_THAT(Run({}, "u,y\n0,1\n").err,
              AllOf(HasSubstr("no column \"u1\""), HasSubstr("--inputs")));
  EXPECT_EQ(server_.estimation.epoch, 0U);
}

TEST_F(EstimateTest, AServerThatStopsIsAFailureAfterWhatCame) {
  server_.estimation.stop_after_batches = 1;
  const Outcome outcome = Run({"--reconnect-for-s", "0"}, "u1,y1\n0,1\n0,2\n0,3\n");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_EQ(outcome.out, std::string(kHeader) + "0,1,0.5,1.5,consistent,\n");
  EXPECT_THAT(outcome.err, HasSubstr("the server stops"));
}

TEST_F(EstimateTest, AServerThatComesBackIsGoneOnWith) {
  server_.estimation.stop_after_batches = 2;
  const Outcome outcome = Run({}, "u1,y1\n0,1\n0,2\n0,3\n");
  EXPECT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.out, std::string(kHeader) +
                             "0,1,0.5,1.5,consistent,\n0.5,2,0.5,1.5,consistent,\n1,3,0.5,1.5,consistent,\n");
  EXPECT_EQ(server_.estimation.epoch, 2U);
}

}  // namespace
}  // namespace metaekf::testing
