#include "core/filter/ekf.h"

#include <gtest/gtest.h>

#include <Eigen/LU>

#include "tests/core/filter/linear_filter.h"
#include "tests/core/nssm/random_models.h"
#include "tests/support/bundles.h"
#include "tests/support/count_allocations.h"

namespace metaekf::filter {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

// Oracle: the exact Kalman filter with textbook formulas, with missing components and wholly missing samples.
TEST(EkfTest, EqualsTheKalmanFilterOnALinearSystem) {
  const LinearSystem s;
  nssm::Bundle bundle = LinearBundle(s);
  Filter filter(bundle, {.initial_mean = VectorXd{{0.5, -0.2}}, .gate = {.probability = 0}});
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

// A true system and the filter that knows it: nothing is gated beyond the false alarms that were asked for, bounds hold what they
// say, and NEES and NIS are χ².
TEST(EkfTest, IsConsistentWithTheSystemThatItKnows) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  double nees = 0, nis = 0;
  int64_t samples = 0, gated = 0, unhealthy = 0;
  constexpr int kRuns = 50, kSteps = 400;
  for (uint64_t run = 0; run < kRuns; ++run) {
    Filter filter(bundle);
    LinearTruth truth(LinearSystem(), run);
    for (int t = 0; t < kSteps; ++t) {
      const VectorXd u = RandomVector(&truth.rng, 1);
      ASSERT_TRUE(filter.ekf.Step(u, truth.Measure(), filter.scratch.get(), &filter.estimate).ok());
      const VectorXd error = filter.estimate.mean - truth.state;
      nees += error.dot(filter.estimate.cov.inverse() * error);
      nis += filter.estimate.nis;
      gated += filter.estimate.gated;
      unhealthy += filter.estimate.health == Health::kConsistent ? 0 : 1;
      ++samples;
      truth.Advance(u[0]);
    }
  }
  // 20,000 samples: the NIS, white, has standard deviation √(2·2/20000) = 0.014 about 2. Errors are correlated over some 20 samples.
  EXPECT_NEAR(nis / static_cast<double>(samples), 2, 0.06);
  EXPECT_NEAR(nees / static_cast<double>(samples), 2, 0.25);
  EXPECT_LE(gated, 1);
  EXPECT_LT(unhealthy, samples / 200);
}

TEST(EkfTest, ASampleMayBringItsOwnNoise) {
  const LinearSystem system;
  const nssm::Bundle bundle = LinearBundle(system);
  LinearSystem noisier = system;
  noisier.R *= 9;
  const nssm::Bundle noisy = LinearBundle(noisier);
  Filter filter(bundle), expected(noisy);
  const MatrixXd R = 9 * system.R;
  base::Rng rng(3);
  for (int t = 0; t < 20; ++t) {
    const VectorXd u = RandomVector(&rng, 1), y = RandomVector(&rng, 2);
    ASSERT_TRUE(filter.ekf.Step(u, y, filter.scratch.get(), &filter.estimate, &R).ok());
    ASSERT_TRUE(expected.ekf.Step(u, y, expected.scratch.get(), &expected.estimate).ok());
    EXPECT_LT((filter.estimate.mean - expected.estimate.mean).norm(), 1e-12);
    EXPECT_LT((filter.estimate.cov - expected.estimate.cov).norm(), 1e-12);
  }
  const FilterState before = filter.ekf.state();
  const MatrixXd wrong = -R;
  EXPECT_EQ(filter.ekf.Step(VectorXd{{0.0}}, VectorXd{{0.0, 0.0}}, filter.scratch.get(), &filter.estimate, &wrong).code(),
            absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(filter.ekf.state().mean, before.mean);
}

TEST(EkfTest, ForecastsAreWhatPassesWithoutMeasurements) {
  const LinearSystem system;
  const nssm::Bundle bundle = LinearBundle(system);
  Filter filter(bundle);
  base::Rng rng(3);
  for (int t = 0; t < 20; ++t) {
    ASSERT_TRUE(filter.ekf.Step(RandomVector(&rng, 1), RandomVector(&rng, 2), filter.scratch.get(), &filter.estimate).ok());
  }
  const MatrixXd inputs = MatrixXd{{0.3, -1, 2}};
  VectorXd x = filter.estimate.mean;
  MatrixXd P = filter.estimate.cov;
  double u = filter.ekf.LastInput()[0];
  const auto forecast = filter.ekf.Forecast(inputs, filter.scratch.get());
  ASSERT_TRUE(forecast.ok());
  ASSERT_EQ(forecast->size(), 3U);
  for (size_t t = 0; t < 3; ++t) {
    x = system.A * x + system.B * u;
    P = system.A * P * system.A.transpose() + system.Q;
    u = inputs(0, static_cast<Eigen::Index>(t));
    EXPECT_LT(((*forecast)[t].mean - x).norm(), 1e-12);
    EXPECT_LT(((*forecast)[t].cov - P).norm(), 1e-12);
  }
  EXPECT_FALSE(filter.ekf.Forecast(MatrixXd{{kNaN}}, filter.scratch.get()).ok());
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
  EXPECT_NE(message({.initial_samples = -1}).find("initial samples"), std::string::npos);
  EXPECT_NE(message({.initial_samples = 5000}).find("initial samples"), std::string::npos);
  EXPECT_NE(message({.gate = {.probability = 1}}).find("gate"), std::string::npos);
  EXPECT_NE(message({.gate = {.recover_after = 0}}).find("gate"), std::string::npos);
}

// On a linear system it does not matter what is linearised about.
TEST(EkfTest, AStartByLeastSquaresIsTheFiltersOnALinearSystem) {
  const nssm::Bundle bundle = LinearBundle(LinearSystem());
  Filter started(bundle, {.initial_samples = 7}), filter(bundle);
  base::Rng rng(3);
  for (int t = 0; t < 20; ++t) {
    const VectorXd u = RandomVector(&rng, 1);
    VectorXd y = RandomVector(&rng, 2);
    if (t % 3 == 1) y[1] = kNaN;
    ASSERT_TRUE(started.ekf.Step(u, y, started.scratch.get(), &started.estimate).ok());
    ASSERT_TRUE(filter.ekf.Step(u, y, filter.scratch.get(), &filter.estimate).ok());
    EXPECT_EQ(started.estimate.health == Health::kWarmingUp, t < 6);
    EXPECT_EQ(started.estimate.mean.allFinite(), t >= 6);
    if (t < 6) continue;
    EXPECT_LT((started.estimate.mean - filter.estimate.mean).norm(), 1e-10) << t;
    EXPECT_LT((started.estimate.cov - filter.estimate.cov).norm(), 1e-10) << t;
  }
}

// A million steps with hardly any noise, an almost exact sensor beside a coarse one, and long gaps.
TEST(EkfTest, TheCovarianceStaysPositiveSemidefiniteForAMillionSteps) {
  for (const auto precision : {nssm::Precision::kFloat32, nssm::Precision::kFloat64}) {
    for (nssm::ModelCase c : nssm::ModelCases()) {
      if (c.name != "Case II, ordered states") continue;
      c.model.precision = precision;
      nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(c.model));
      bundle.parameters = nssm::RandomParameters(bundle.model, 3);
      nssm::RoundToPrecision(precision, &bundle.parameters);
      bundle.noise.process = 1e-14 * MatrixXd::Identity(2, 2);
      bundle.noise.measurement = Eigen::Vector2d(1e-12, 1e4).asDiagonal();
      Filter filter(bundle);
      base::Rng rng(1);
      for (int t = 0; t < 500'000; ++t) {
        const bool gap = t % 1000 < 500;
        const VectorXd u = RandomVector(&rng, 1), y = gap ? VectorXd::Constant(2, kNaN) : RandomVector(&rng, 2);
        ASSERT_TRUE(filter.ekf.Step(u, y, filter.scratch.get(), &filter.estimate).ok());
        const MatrixXd& P = filter.estimate.cov;
        ASSERT_EQ(P(0, 1), P(1, 0)) << t;
        // Positive semidefinite to the rounding of P itself.
        ASSERT_GE(P.determinant(), -1e-15 * P(0, 0) * P(1, 1)) << t;
        ASSERT_GE(std::min(P(0, 0), P(1, 1)), 0) << t;
      }
    }
  }
}

#if !METAEKF_SANITIZED
TEST(EkfTest, AStepDoesNotAllocate) {
  for (const nssm::ModelCase& c : nssm::ModelCases()) {
    nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(c.model));
    bundle.parameters = nssm::RandomParameters(bundle.model, 3);
    bundle.noise.process_bias = {MatrixXd::Ones(bundle.noise.process.rows(), 2), 0.9};
    bundle.noise.measurement_bias = {MatrixXd::Ones(bundle.noise.measurement.rows(), 1), 0.9};
    const MatrixXd unknown = MatrixXd::Constant(bundle.model.layout().size(), 2, 1e-3);
    Filter filter(bundle);
    for (const bool with_unknown : {false, true}) {
      if (with_unknown) filter.ekf = *Ekf::Create(bundle, filter.model, filter.model->Prepare(bundle.parameters, unknown), {});
      const VectorXd u = VectorXd::Ones(c.model.input_size), y = VectorXd::Ones(c.model.output_size);
      for (int t = 0; t < 5; ++t) {
        const long before = support::allocations;
        ASSERT_TRUE(filter.ekf.Step(u, y, filter.scratch.get(), &filter.estimate).ok());
        const bool moved = bundle.model.output_set() != nullptr || filter.estimate.projection > 0;
        if (moved) continue;
        EXPECT_EQ(support::allocations, before) << c.name << (with_unknown ? ", parameters unknown" : "");
      }
    }
  }
}
#endif

}  // namespace
}  // namespace metaekf::filter
