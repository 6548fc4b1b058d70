#include "core/filter/ekf.h"

#include <gtest/gtest.h>

#include <Eigen/LU>

#include "tests/core/nssm/random_models.h"
#include "tests/support/bundles.h"
#include "tests/support/count_allocations.h"

namespace metaekf::filter {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

VectorXd RandomVector(base::Rng* rng, Eigen::Index n) {
  VectorXd v(n);
  for (double& value : v) value = rng->Normal();
  return v;
}

TEST(FilterModelTest, JacobiansMatchCentralDifferencesForEveryKindOfModel) {
  for (const nssm::ModelCase& c : nssm::ModelCases()) {
    SCOPED_TRACE(c.name);
    const nssm::Model model = *nssm::Model::Create(c.model);
    const auto filter_model = FilterModel::Create(nssm::Bundle{.model = model});
    const auto parameters = filter_model->Prepare(nssm::RandomParameters(model, 5));
    const auto scratch = filter_model->MakeScratch();
    const Eigen::Index n = filter_model->state_size(), n_y = c.model.output_size;
    base::Rng rng(9);
    const VectorXd x = RandomVector(&rng, n), u = RandomVector(&rng, c.model.input_size);
    VectorXd f(n), f_up(n), f_down(n), h(n_y), h_up(n_y), h_down(n_y);
    MatrixXd F(n, n), H(n_y, n), ignored(std::max(n, n_y), n);
    filter_model->Transition(*parameters, x, u, &f, &F, scratch.get());
    filter_model->Measurement(*parameters, x, u, &h, &H, scratch.get());
    const double step = 1e-6;
    for (Eigen::Index j = 0; j < n; ++j) {
      VectorXd up = x, down = x;
      up[j] += step;
      down[j] -= step;
      MatrixXd unused_F(n, n), unused_H(n_y, n);
      filter_model->Transition(*parameters, up, u, &f_up, &unused_F, scratch.get());
      filter_model->Transition(*parameters, down, u, &f_down, &unused_F, scratch.get());
      filter_model->Measurement(*parameters, up, u, &h_up, &unused_H, scratch.get());
      filter_model->Measurement(*parameters, down, u, &h_down, &unused_H, scratch.get());
      EXPECT_LT((F.col(j) - (f_up - f_down) / (2 * step)).norm(), 1e-7 * (1 + F.norm()));
      EXPECT_LT((H.col(j) - (h_up - h_down) / (2 * step)).norm(), 1e-7 * (1 + H.norm()));
    }
    if (c.model.is_curl_free()) {
      // Positions are states 1 and 0 in that order: curl = ∂h₀/∂x₀ − ∂h₁/∂x₁ of the listed components.
      EXPECT_NEAR(H(0, 0), H(1, 1), 1e-12 * (1 + H.norm()));
    }
  }
}

/// A linear Case II model x⁺ = A x + B u, y = C x in the parameters of a network without hidden layers.
struct LinearSystem {
  MatrixXd A{{0.9, 0.2}, {-0.1, 0.95}}, B{{0.1}, {0.5}}, C{{1, 0}, {0.3, 1}};
  MatrixXd Q{{0.02, 0.005}, {0.005, 0.01}}, R{{0.3, 0.1}, {0.1, 0.2}}, P0{{2, 0.3}, {0.3, 1}};
};

nssm::Bundle LinearBundle(const LinearSystem& system) {
  nssm::ModelSpec spec{.kind = nssm::Case::kStateInputOutput, .input_size = 1, .output_size = 2, .state_size = 2, .latent_size = 3, .window = 1};
  spec.precision = nssm::Precision::kFloat64;
  nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(spec));
  bundle.noise = {system.Q, system.R, system.P0};
  // ψ = [x; u]; 𝓐 advances it and drops u; 𝓓x and 𝓓y read x.
  support::SetWeight("encoder.0.weight", MatrixXd::Identity(3, 3), &bundle);
  MatrixXd transition = MatrixXd::Zero(3, 4);
  transition.topLeftCorner(2, 2) = system.A;
  transition.block(0, 2, 2, 1) = 0.5 * system.B;  // u enters twice: through ψ and beside it
  transition.block(0, 3, 2, 1) = 0.5 * system.B;
  support::SetWeight("transition.0.weight", transition, &bundle);
  support::SetWeight("state_decoder.0.weight", MatrixXd::Identity(2, 3), &bundle);
  MatrixXd output = MatrixXd::Zero(2, 3);
  output.leftCols(2) = system.C;
  support::SetWeight("output_decoder.0.weight", output, &bundle);
  return bundle;
}

struct Filter {
  explicit Filter(const nssm::Bundle& bundle, const FilterOptions& options = {})
      : model(FilterModel::Create(bundle)),
        scratch(model->MakeScratch()),
        ekf(*Ekf::Create(bundle, model, model->Prepare(bundle.parameters), options)),
        estimate(ekf.MakeEstimate()) {}
  std::shared_ptr<FilterModel> model;
  std::unique_ptr<FilterModel::Scratch> scratch;
  Ekf ekf;
  Estimate estimate;
};

// Oracle: the exact Kalman filter with textbook formulas, with missing components and wholly missing samples.
TEST(EkfTest, EqualsTheKalmanFilterOnALinearSystem) {
  const LinearSystem s;
  nssm::Bundle bundle = LinearBundle(s);
  Filter filter(bundle, {.initial_mean = VectorXd{{0.5, -0.2}}});
  base::Rng rng(4);
  VectorXd x{{0.5, -0.2}};
  MatrixXd P = s.P0;
  double u_last = 0;
  for (int t = 0; t < 300; ++t) {
    const VectorXd u = RandomVector(&rng, 1);
    VectorXd y = 3 * RandomVector(&rng, 2);
    for (double& value : y) {
      if (rng.Uniform() < 0.2) value = kNaN;
    }
    ASSERT_TRUE(filter.ekf.Step(u, y, filter.scratch.get(), &filter.estimate).ok());
    if (t > 0) {
      x = s.A * x + s.B * u_last;
      P = s.A * P * s.A.transpose() + s.Q;
    }
    u_last = u[0];
    std::vector<Eigen::Index> rows;
    for (Eigen::Index i = 0; i < 2; ++i) {
      if (!std::isnan(y[i])) rows.push_back(i);
    }
    if (!rows.empty()) {
      const MatrixXd H = s.C(rows, Eigen::all), R = s.R(rows, rows);
      const VectorXd innovation = VectorXd(y(rows)) - H * x;
      const MatrixXd S = H * P * H.transpose() + R, K = P * H.transpose() * S.inverse();
      EXPECT_NEAR(filter.estimate.nis, innovation.dot(S.inverse() * innovation), 1e-10);
      EXPECT_TRUE(MatrixXd(filter.estimate.innovation_cov(rows, rows)).isApprox(S, 1e-10));
      EXPECT_TRUE(VectorXd(filter.estimate.innovation(rows)).isApprox(innovation, 1e-10));
      x += K * innovation;
      P = (MatrixXd::Identity(2, 2) - K * H) * P;
    } else {
      EXPECT_TRUE(std::isnan(filter.estimate.nis));
    }
    EXPECT_LT((filter.estimate.mean - x).norm(), 1e-10);
    EXPECT_LT((filter.estimate.cov - P).norm(), 1e-10);
    EXPECT_EQ(filter.estimate.measured, static_cast<int>(rows.size()));
  }
}

// The same data in other units must give the same estimates in those units.
TEST(EkfTest, NormalisationIsInvisibleOutside) {
  const LinearSystem s;
  const nssm::Bundle plain = LinearBundle(s);
  nssm::Bundle scaled = plain;
  scaled.normaliser.outputs = {VectorXd{{3, -1}}, VectorXd{{10, 0.1}}};
  scaled.normaliser.states = {VectorXd{{5, 2}}, VectorXd{{4, 0.5}}};
  scaled.normaliser.inputs = {VectorXd{{1}}, VectorXd{{7}}};
  const VectorXd sy = scaled.normaliser.outputs.scale, sx = scaled.normaliser.states.scale;
  scaled.noise = {sx.asDiagonal() * s.Q * sx.asDiagonal(), sy.asDiagonal() * s.R * sy.asDiagonal(),
                  sx.asDiagonal() * s.P0 * sx.asDiagonal()};
  Filter a(plain), b(scaled);
  base::Rng rng(4);
  for (int t = 0; t < 50; ++t) {
    const VectorXd u = RandomVector(&rng, 1), y = RandomVector(&rng, 2);
    ASSERT_TRUE(a.ekf.Step(u, y, a.scratch.get(), &a.estimate).ok());
    const VectorXd u_scaled = u.cwiseProduct(scaled.normaliser.inputs.scale) + scaled.normaliser.inputs.mean;
    const VectorXd y_scaled = y.cwiseProduct(sy) + scaled.normaliser.outputs.mean;
    ASSERT_TRUE(b.ekf.Step(u_scaled, y_scaled, b.scratch.get(), &b.estimate).ok());
    EXPECT_TRUE(b.estimate.mean.isApprox(a.estimate.mean.cwiseProduct(sx) + scaled.normaliser.states.mean, 1e-10));
    EXPECT_TRUE(b.estimate.cov.isApprox(sx.asDiagonal() * a.estimate.cov * sx.asDiagonal(), 1e-9));
    EXPECT_NEAR(a.estimate.nis, b.estimate.nis, 1e-9);
  }
}

nssm::Bundle CaseOneBundle() {
  const nssm::ModelCase c = nssm::ModelCases().front();
  nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(c.model));
  bundle.parameters = nssm::RandomParameters(bundle.model, 3);
  return bundle;
}

TEST(EkfTest, CaseOneWarmsUpUntilTheWindowIsFullAndStartsAnewBehindAGap) {
  const nssm::Bundle bundle = CaseOneBundle();  // H = 2, two outputs
  Filter filter(bundle);
  const VectorXd u{{0.1}}, y{{0.2, -0.3}}, gap{{0.2, kNaN}};
  std::vector<bool> warming;
  for (const VectorXd& sample : {y, gap, y, y, gap, y}) {
    ASSERT_TRUE(filter.ekf.Step(u, sample, filter.scratch.get(), &filter.estimate).ok());
    warming.push_back(filter.estimate.health == Health::kWarmingUp);
    EXPECT_EQ(std::isnan(filter.estimate.mean[0]), warming.back());
  }
  EXPECT_EQ(warming, (std::vector<bool>{true, true, true, false, false, false}));
}

TEST(EkfTest, BadSamplesAreRefusedAndChangeNothing) {
  const nssm::Bundle bundle = CaseOneBundle();
  Filter filter(bundle);
  const VectorXd u{{0.1}}, y{{0.2, -0.3}};
  for (int t = 0; t < 4; ++t) ASSERT_TRUE(filter.ekf.Step(u, y, filter.scratch.get(), &filter.estimate).ok());
  const FilterState before = filter.ekf.state();
  const double inf = std::numeric_limits<double>::infinity();
  const std::pair<VectorXd, VectorXd> bad[] = {
      {VectorXd{{kNaN}}, y}, {VectorXd{{inf}}, y}, {u, VectorXd{{0.1, -inf}}}, {u, VectorXd{{0.1}}}, {VectorXd(0), y}};
  for (const auto& [input, output] : bad) {
    EXPECT_EQ(filter.ekf.Step(input, output, filter.scratch.get(), &filter.estimate).code(),
              absl::StatusCode::kInvalidArgument);
  }
  EXPECT_EQ(filter.ekf.state().mean, before.mean);
  EXPECT_EQ(filter.ekf.state().factor, before.factor);
  EXPECT_EQ(filter.ekf.state().samples, before.samples);
}

TEST(EkfTest, ARestoredFilterGoesOnBitForBit) {
  const nssm::Bundle bundle = CaseOneBundle();
  Filter a(bundle), b(bundle);
  base::Rng rng(8);
  for (int t = 0; t < 40; ++t) {
    const VectorXd u = RandomVector(&rng, 1), y = RandomVector(&rng, 2);
    if (t == 17) b.ekf.Restore(a.ekf.state());
    ASSERT_TRUE(a.ekf.Step(u, y, a.scratch.get(), &a.estimate).ok());
    if (t < 17) continue;
    ASSERT_TRUE(b.ekf.Step(u, y, b.scratch.get(), &b.estimate).ok());
    EXPECT_EQ(a.estimate.mean, b.estimate.mean);
    EXPECT_EQ(a.estimate.cov, b.estimate.cov);
  }
}

TEST(EkfTest, WrongNoiseIsRefusedByName) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  const std::shared_ptr<FilterModel> model = FilterModel::Create(bundle);
  const std::shared_ptr<FilterModel::Parameters> parameters = model->Prepare(bundle.parameters);
  const auto message = [&](const FilterOptions& options) {
    return std::string(Ekf::Create(bundle, model, parameters, options).status().message());
  };
  EXPECT_NE(message({.process_cov = MatrixXd::Identity(3, 3)}).find("process noise covariance Q"), std::string::npos);
  EXPECT_NE(message({.measurement_cov = MatrixXd::Zero(2, 2)}).find("positive definite"), std::string::npos);
  EXPECT_NE(message({.initial_cov = -MatrixXd::Identity(2, 2)}).find("initial covariance"), std::string::npos);
  EXPECT_NE(message({.initial_mean = VectorXd::Zero(3)}).find("initial mean"), std::string::npos);
}

// Weights and measurements of any size, in float and double: whatever the filter makes of them, what it says is inside.
TEST(EkfTest, EstimatesOfConstrainedStatesAreInsideWhateverTheWeights) {
  int64_t estimates = 0, projected = 0;
  for (uint64_t seed = 0; seed < 60; ++seed) {
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
        if (filter.estimate.health == Health::kDiverged) break;
        ASSERT_TRUE(physics::Contains(*bundle.model.state_set(), filter.estimate.mean)) << "seed " << seed << ", step " << t;
        ++estimates;
        projected += filter.estimate.projection > 0 ? 1 : 0;
      }
    }
  }
  EXPECT_GT(estimates, 10000);
  EXPECT_GT(projected, 500);
}

#if METAEKF_COUNTS_ALLOCATIONS
TEST(EkfTest, AStepDoesNotAllocate) {
  for (const nssm::ModelCase& c : nssm::ModelCases()) {
    nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(c.model));
    bundle.parameters = nssm::RandomParameters(bundle.model, 3);
    Filter filter(bundle);
    const VectorXd u = VectorXd::Ones(c.model.input_size), y = VectorXd::Ones(c.model.output_size);
    for (int t = 0; t < 5; ++t) {
      const long before = support::allocations;
      ASSERT_TRUE(filter.ekf.Step(u, y, filter.scratch.get(), &filter.estimate).ok());
      const bool moved = bundle.model.output_set() != nullptr || filter.estimate.projection > 0;
      if (moved) continue;
      EXPECT_EQ(support::allocations, before) << c.name;
    }
  }
}
#endif

}  // namespace
}  // namespace metaekf::filter
