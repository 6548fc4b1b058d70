// Trainings that begin several times and go on with the best beginning.

#include <gtest/gtest.h>

#include <algorithm>
#include <map>
#include <vector>

#include "core/meta/train.h"
#include "tests/core/meta/small_training.h"

namespace metaekf::meta {
namespace {

/// Validation losses by step, and the model that came out.
struct Course {
  std::map<int32_t, double> losses;
  std::vector<double> parameters;
};

Course CourseOf(const TrainingSpec& spec) {
  base::Executor* const executor = base::CallingThread();
  Course course;
  const absl::StatusOr<nssm::Bundle> bundle = Train(spec, Fleet(10, 80, 1), nullptr, executor, [&](const TrainingProgress& p) {
    EXPECT_LE(p.state.iteration, p.iterations);
    if (p.validated) course.losses[p.state.iteration] = p.state.validation_loss;
    return true;
  });
  EXPECT_TRUE(bundle.ok()) << bundle.status();
  if (bundle.ok()) course.parameters = bundle->parameters;
  return course;
}

Course CourseWith(TrainingSpec spec, int32_t restarts, int32_t screening_iterations) {
  spec.restarts = restarts;
  spec.screening_iterations = screening_iterations;
  return CourseOf(spec);
}

TEST(RestartsTest, TheBestStartOfAllGoesOn) {
  TrainingSpec spec = SmallSpec();
  for (spec.seed = 0;; ++spec.seed) {
    ASSERT_LT(spec.seed, 50u);
    const Course alone = CourseOf(spec), screened = CourseWith(spec, 4, 20);
    EXPECT_EQ(screened.losses.at(20), alone.losses.at(20));
    EXPECT_EQ(screened.losses.rbegin()->first, 30 + 3 * 20);
    std::vector<double> ends;
    for (const int32_t end : {20, 40, 60, 80}) ends.push_back(screened.losses.at(end));
    const auto best = std::min_element(ends.begin(), ends.end());
    if (best == ends.begin() || best + 1 == ends.end()) continue;  // could be had without choosing
    EXPECT_NE(screened.parameters, alone.parameters);
    // Screened to the end, the model is that of the best: those behind it change nothing.
    const Course to_the_end = CourseWith(spec, 4, spec.iterations);
    ends.clear();
    for (const int32_t end : {30, 60, 90, 120}) ends.push_back(to_the_end.losses.at(end));
    EXPECT_EQ(to_the_end.losses.size(), 12u);
    const int32_t up_to_it = 1 + static_cast<int32_t>(std::min_element(ends.begin(), ends.end()) - ends.begin());
    EXPECT_EQ(CourseWith(spec, up_to_it, spec.iterations).parameters, to_the_end.parameters);
    return;
  }
}

TEST(RestartsTest, WithTheFirstStartBestTheyChangeNothing) {
  TrainingSpec spec = SmallSpec();
  for (spec.seed = 0;; ++spec.seed) {
    ASSERT_LT(spec.seed, 50u);
    const Course alone = CourseOf(spec), screened = CourseWith(spec, 2, 20);
    if (screened.losses.at(40) <= alone.losses.at(20)) continue;  // the second was better
    EXPECT_EQ(screened.parameters, alone.parameters);
    EXPECT_EQ(screened.losses.at(50), alone.losses.at(30));
    return;
  }
}

TEST(RestartsTest, IfAllStartsDivergeTheTrainingHas) {
  TrainingSpec spec = SmallSpec();
  spec.restarts = 3;
  spec.screening_iterations = 20;
  spec.warmup_iterations = 0;
  spec.outer_lr = spec.final_outer_lr = 1e3;
  base::Executor* const executor = base::CallingThread();
  int32_t last = 0;
  const absl::Status status = Train(spec, Fleet(10, 80, 1), nullptr, executor, [&](const TrainingProgress& p) {
                                last = p.state.iteration;
                                return true;
                              }).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kOutOfRange) << status;
  EXPECT_GE(last, 2 * 20);
}

}  // namespace
}  // namespace metaekf::meta
