#include "core/filter/ekf.h"

#include <gtest/gtest.h>

#include "tests/core/filter/linear_filter.h"
#include "tests/core/nssm/random_models.h"
#include "tests/support/bundles.h"

namespace metaekf::filter {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

// Weights and measurements of any size, in float and double: whatever the filter makes of them, what it says is inside.
TEST(EkfConstraintTest, EstimatesOfConstrainedStatesAreInsideWhateverTheWeights) {
  int64_t estimates = 0, projected = 0;
  for (uint64_t seed = 0; seed < 2600; ++seed) {
    base::Rng rng(seed);
    for (nssm::ModelCase c : nssm::ModelCases()) {
      if (c.name != "Case II, ordered states") continue;
      if (seed % 2 == 0) c.model.precision = nssm::Precision::kFloat32;
      c.model.state_set.mean = 10 * RandomVector(&rng, 2);
      c.model.state_set.scale = Eigen::Vector2d(rng.Uniform(0.1, 10), rng.Uniform(0.1, 10));
      nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(c.model));
      bundle.normaliser.states = {c.model.state_set.mean, c.model.state_set.scale};
      const double size = std::pow(10.0, rng.Uniform(-2, 2));
      for (double& parameter : bundle.parameters) parameter = size * rng.Normal();
      nssm::RoundToPrecision(c.model.precision, &bundle.parameters);
      Filter filter(bundle);
      for (int t = 0; t < 400; ++t) {
        const VectorXd u = RandomVector(&rng, 1), y = std::pow(10.0, rng.Uniform(-2, 3)) * RandomVector(&rng, 2);
        ASSERT_TRUE(filter.ekf.Step(u, y, filter.scratch.get(), &filter.estimate).ok());
        if (filter.estimate.health == Health::kDiverged) continue;  // it begins anew
        ASSERT_TRUE(physics::Contains(*bundle.model.state_set(), filter.estimate.mean)) << "seed " << seed << ", step " << t;
        ++estimates;
        projected += filter.estimate.projection > 0 ? 1 : 0;
      }
    }
  }
  EXPECT_GT(estimates, 1000000);
  EXPECT_GT(projected, 50000);
}

TEST(EkfConstraintTest, TheAutoencoderPutsEstimatesInsideAndTakesTheirCovarianceAlong) {
  int projected = 0;
  for (const nssm::ModelCase& c : nssm::ModelCases()) {
    if (c.name != "Case II, ordered states") continue;
    for (uint64_t seed = 0; seed < 20; ++seed) {
      nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(c.model));
      bundle.parameters = nssm::RandomParameters(bundle.model, seed);
      Filter filter(bundle, {.projection = Projection::kAutoencoder}), free(bundle, {.projection = Projection::kNone});
      const auto& set = *bundle.model.state_set();
      base::Rng rng(seed);
      for (int t = 0; t < 100; ++t) {
        const VectorXd u = RandomVector(&rng, 1), y = 3 * RandomVector(&rng, 2);
        free.ekf.Restore(filter.ekf.state());  // the same step without projection
        ASSERT_TRUE(filter.ekf.Step(u, y, filter.scratch.get(), &filter.estimate).ok());
        ASSERT_TRUE(free.ekf.Step(u, y, free.scratch.get(), &free.estimate).ok());
        EXPECT_TRUE(physics::Contains(set, filter.estimate.mean));
        EXPECT_EQ(filter.estimate.slack, free.estimate.slack);
        EXPECT_EQ(free.estimate.projection, 0);
        if (filter.estimate.projection == 0) {
          EXPECT_EQ(filter.estimate.mean, free.estimate.mean);
          continue;
        }
        ++projected;
        EXPECT_LT(free.estimate.slack, 0);
        EXPECT_FALSE(physics::Contains(set, free.estimate.mean));
        VectorXd reconstruction(2);
        MatrixXd J(2, 2);
        filter.model->Reconstruct(*filter.model->Prepare(bundle.parameters), free.ekf.state().mean, u, &reconstruction, &J, filter.scratch.get());
        EXPECT_LT((filter.estimate.mean - reconstruction).norm(), 1e-12 * (1 + reconstruction.norm()));
        EXPECT_LT((filter.estimate.cov - J * free.estimate.cov * J.transpose()).norm(), 1e-10 * (1 + free.estimate.cov.norm()));
      }
    }
  }
  EXPECT_GT(projected, 50);
}

}  // namespace
}  // namespace metaekf::filter
