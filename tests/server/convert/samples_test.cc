#include "server/convert/samples.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>

namespace metaekf::server {
namespace {

using ::testing::HasSubstr;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr SampleRules kRules = {.channels = {2, 1, 0}, .sample_period_s = 0.1, .max_samples = 100};

/// Two inputs and one output counted up from `first`.
v1::Samples Counted(const std::string& trajectory, int first, uint32_t count) {
  v1::Samples samples;
  samples.set_trajectory(trajectory);
  samples.set_sample_count(count);
  for (uint32_t t = 0; t < count; ++t) {
    samples.add_inputs(first + t);
    samples.add_inputs(-(first + static_cast<double>(t)));
    samples.add_outputs(100.0 * (first + t));
  }
  return samples;
}

std::string Error(const SampleRules& rules, const v1::Samples& samples) {
  const absl::Status status = SampleChecker(rules).Add(samples);
  EXPECT_FALSE(status.ok());
  return std::string(status.message());
}

TEST(SamplesTest, PiecesMakeTrajectories) {
  TrajectoryAssembler assembler(kRules);
  v1::Samples first = Counted("a", 0, 2);
  first.set_start_time_s(5);
  first.set_sample_period_s(0.1);
  EXPECT_FALSE(assembler.Add(first)->has_value());
  EXPECT_FALSE(assembler.Add(Counted("a", 2, 1))->has_value());
  const auto a = assembler.Add(Counted("b", 7, 1)).value();
  ASSERT_TRUE(a.has_value());
  EXPECT_EQ(a->name, "a");
  EXPECT_EQ(a->start_s, 5);
  EXPECT_EQ(a->sample_period_s, 0.1);
  ASSERT_EQ(a->length(), 3);
  EXPECT_EQ(a->inputs(0, 2), 2);
  EXPECT_EQ(a->inputs(1, 1), -1);
  EXPECT_EQ(a->outputs(0, 2), 200);
  EXPECT_EQ(a->states.rows(), 0);
  EXPECT_EQ(a->states.cols(), 3);
  const auto b = assembler.Finish();
  ASSERT_TRUE(b.has_value());
  EXPECT_EQ(b->name, "b");
  EXPECT_EQ(b->inputs(1, 0), -7);
}

TEST(SamplesTest, NothingMakesNothing) {
  EXPECT_FALSE(TrajectoryAssembler(kRules).Finish().has_value());
}

TEST(SamplesTest, SizesMustFit) {
  v1::Samples samples = Counted("a", 0, 3);
  samples.add_inputs(1);
  EXPECT_THAT(Error(kRules, samples), HasSubstr("samples.inputs: trajectory 'a', samples from 0: 7 "
                                                "values, expected 6 (3 samples of 2)"));
  samples = Counted("a", 0, 3);
  samples.add_states(1);
  EXPECT_THAT(Error(kRules, samples), HasSubstr("samples.states: "));
  // As many samples as the multiplication of 32-bit numbers would lose.
  samples = Counted("a", 0, 1);
  samples.set_sample_count(0x80000001);
  EXPECT_THAT(Error(kRules, samples), HasSubstr("expected 4294967298"));
}

TEST(SamplesTest, ValuesMustBeFinite) {
  v1::Samples samples = Counted("a", 0, 3);
  samples.set_inputs(3, INFINITY);
  EXPECT_THAT(Error(kRules, samples),
              HasSubstr("samples.inputs[3]: trajectory 'a', sample 1: input 2 is inf"));
  samples = Counted("a", 0, 3);
  samples.set_outputs(2, kNaN);
  EXPECT_THAT(Error(kRules, samples), HasSubstr("sample 2: output 1 is nan"));
}

TEST(SamplesTest, MeasurementsMayMissWhereTheRulesSaySo) {
  SampleRules rules = kRules;
  rules.missing_measurements = true;
  v1::Samples samples = Counted("a", 0, 3);
  samples.set_outputs(1, kNaN);
  TrajectoryAssembler assembler(rules);
  EXPECT_TRUE(assembler.Add(samples).ok());
  samples = Counted("a", 3, 2);
  samples.clear_outputs();
  EXPECT_TRUE(assembler.Add(samples).ok());
  const auto trajectory = assembler.Finish().value();
  EXPECT_TRUE(std::isnan(trajectory.outputs(0, 1)));
  EXPECT_EQ(trajectory.outputs(0, 2), 200);
  EXPECT_TRUE(std::isnan(trajectory.outputs(0, 4)));
  samples = Counted("a", 0, 1);
  samples.set_outputs(0, INFINITY);
  EXPECT_THAT(Error(rules, samples), HasSubstr("output 1 is inf"));
  samples = Counted("a", 0, 1);
  samples.set_inputs(0, kNaN);
  EXPECT_THAT(Error(rules, samples), HasSubstr("input 1 is nan"));
}

TEST(SamplesTest, ThePeriodMustBeTheModels) {
  v1::Samples samples = Counted("a", 0, 1);
  samples.set_sample_period_s(0.2);
  EXPECT_THAT(Error(kRules, samples), HasSubstr("'a' has 0.2 s, the model 0.1 s"));
  for (const double wrong : {-0.1, kNaN, static_cast<double>(INFINITY)}) {
    samples.set_sample_period_s(wrong);
    EXPECT_THAT(Error(kRules, samples), HasSubstr("samples.sample_period_s: "));
  }
  samples.set_sample_period_s(0.100005);  // rounded times in a file
  EXPECT_TRUE(SampleChecker(kRules).Add(samples).ok());
  samples.set_start_time_s(kNaN);
  EXPECT_THAT(Error(kRules, samples), HasSubstr("start time"));
}

TEST(SamplesTest, ATrajectoryComesInOnePiece) {
  SampleChecker checker(kRules);
  ASSERT_TRUE(checker.Add(Counted("a", 0, 1)).ok());
  ASSERT_TRUE(checker.Add(Counted("b", 0, 1)).ok());
  EXPECT_THAT(std::string(checker.Add(Counted("a", 1, 1)).message()),
              HasSubstr("samples.trajectory: 'a' goes on"));
}

TEST(SamplesTest, EmptyMessagesAndTooManySamplesAreRefused) {
  EXPECT_THAT(Error(kRules, v1::Samples()), HasSubstr("samples.sample_count: "));
  SampleChecker checker(kRules);
  EXPECT_TRUE(checker.Add(Counted("a", 0, 100)).ok());
  EXPECT_EQ(checker.Add(Counted("a", 0, 1)).code(), absl::StatusCode::kResourceExhausted);
}

}  // namespace
}  // namespace metaekf::server
