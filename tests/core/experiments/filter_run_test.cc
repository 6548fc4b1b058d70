#include "core/experiments/filter_run.h"

#include <gtest/gtest.h>

#include "tests/core/filter/linear_filter.h"

namespace metaekf::experiments {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr int64_t kContext = 3, kSamples = 40;

data::Trajectory Recording(const filter::LinearSystem& system) {
  base::Rng rng(5);
  data::Trajectory recording{.sample_period_s = 0.1, .inputs = MatrixXd(1, kSamples), .outputs = MatrixXd(2, kSamples), .states = MatrixXd(2, kSamples)};
  VectorXd state = VectorXd::Zero(2);
  for (Eigen::Index t = 0; t < kSamples; ++t) {
    recording.inputs(0, t) = rng.Normal();
    recording.states.col(t) = state;
    recording.outputs.col(t) = system.C * state + 0.3 * filter::RandomVector(&rng, 2);
    state = system.A * state + system.B * recording.inputs(0, t) + 0.1 * filter::RandomVector(&rng, 2);
  }
  return recording;
}

// What was known at the last sample of the context is where the filter begins, a step later.
TEST(FilterRunTest, BeginsWithTheStateThatTheContextEndsIn) {
  const filter::LinearSystem system;
  const data::Trajectory recording = Recording(system);
  const nssm::Bundle bundle = filter::LinearBundle(system);
  const absl::StatusOr<FilterRun> run = FilterAfterContext(bundle, filter::FilterModel::Create(bundle), recording, kContext);
  ASSERT_TRUE(run.ok()) << run.status();
  ASSERT_EQ(run->means.cols(), kSamples - kContext);
  const VectorXd first = system.A * recording.states.col(kContext - 1) + system.B * recording.inputs.col(kContext - 1);
  filter::Filter same(bundle, {.initial_mean = first, .initial_cov = system.Q});
  for (Eigen::Index t = 0; t < run->means.cols(); ++t) {
    ASSERT_TRUE(same.ekf.Step(recording.inputs.col(kContext + t), recording.outputs.col(kContext + t), same.scratch.get(), &same.estimate).ok());
    EXPECT_LT((run->means.col(t) - same.estimate.mean).norm(), 1e-12);
    EXPECT_LT((run->deviations.col(t) - same.estimate.cov.diagonal().cwiseSqrt()).norm(), 1e-12);
    EXPECT_EQ(run->nis[t], same.estimate.nis);
  }
  EXPECT_EQ(run->health.size(), static_cast<size_t>(kSamples - kContext));
}

// A filter that is wrong about the recording is right about the errors that it believes in.
TEST(FilterRunTest, WhatAFilterBelievesIsHeldByItsBounds) {
  filter::LinearSystem system;
  system.Q *= 0.01;
  const data::Trajectory recording = Recording(system);
  const nssm::Bundle bundle = filter::LinearBundle(system);
  const std::shared_ptr<const filter::FilterModel> functions = filter::FilterModel::Create(bundle);
  const FilterRun run = *FilterAfterContext(bundle, functions, recording, kContext);
  EXPECT_LT(Coverage(run, run.means - recording.states.rightCols(run.means.cols()), 1.96), 0.8);
  const std::vector<double> held = *CoverageByChance(bundle, functions, recording, kContext, 1.96, 2000, base::Rng(1));
  EXPECT_NEAR(Eigen::Map<const VectorXd>(held.data(), 2000).mean(), 0.95, 0.01);
  // Errors last, so that a recording's own figure is far from that in some.
  EXPECT_LT(*std::min_element(held.begin(), held.end()), 0.7);
}

TEST(FilterRunTest, CoverageIsTheShareOfErrorsInside) {
  const FilterRun run{.deviations = MatrixXd{{1, 1}, {2, 2}}};
  EXPECT_EQ(Coverage(run, MatrixXd{{1.5, -2.5}, {3.9, -4.1}}, 2), 0.5);
}

}  // namespace
}  // namespace metaekf::experiments
