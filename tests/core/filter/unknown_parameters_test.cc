// The filter of an adapted model whose parameters are known up to N(0, V Vᵀ).

#include <gtest/gtest.h>

#include <Eigen/LU>

#include "core/filter/ekf.h"
#include "core/filter/unknown_directions.h"
#include "tests/core/filter/linear_filter.h"
#include "tests/core/nssm/random_models.h"
#include "tests/support/bundles.h"

namespace metaekf::filter {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// A posterior of one tensor with a covariance of its own.
nssm::Bundle WithPosterior(nssm::Bundle bundle, const std::string& tensor, const MatrixXd& covariance) {
  bundle.posterior.emplace();
  bundle.posterior->information = covariance.inverse();
  bundle.posterior->mask = *nn::ParseMask(tensor, bundle.model.layout());
  return bundle;
}

TEST(UnknownParametersTest, DirectionsAreTheWidestOfThePosterior) {
  nssm::Bundle bundle = LinearBundle(LinearSystem());
  const nn::Tensor& tensor = bundle.model.layout().tensors()[0];
  MatrixXd covariance = MatrixXd::Identity(tensor.size(), tensor.size());
  for (Index i = 0; i < tensor.size(); ++i) covariance(i, i) = static_cast<double>(i + 1);
  const MatrixXd V = UnknownDirections(WithPosterior(bundle, tensor.name, covariance));
  ASSERT_EQ(V.rows(), bundle.model.layout().size());
  ASSERT_EQ(V.cols(), std::min<Index>(kMostDirections, tensor.size()));
  MatrixXd kept = MatrixXd::Zero(V.rows(), V.rows());
  for (Index k = 0; k < V.cols(); ++k) {
    const Index i = tensor.size() - 1 - k;
    kept(tensor.offset + i, tensor.offset + i) = covariance(i, i);
  }
  EXPECT_LT((V * V.transpose() - kept).norm(), 1e-10);
  EXPECT_EQ(UnknownDirections(bundle).cols(), 0);
}

TEST(UnknownParametersTest, DirectionsInWhichNoSystemsDifferAreLeftOut) {
  nssm::Bundle bundle = LinearBundle(LinearSystem());
  bundle = WithPosterior(bundle, "transition.0.bias", Eigen::Vector3d(4, 1, 9).asDiagonal().toDenseMatrix());
  bundle.prior.emplace().examples = MatrixXd{{1, 0, -1, 0}, {0, 2, 0, -2}, {5, 5, 5, 5}};  // the third is the same in all of them
  const MatrixXd V = UnknownDirections(bundle);
  EXPECT_EQ(V.cols(), 2);
  for (const nn::Tensor& tensor : bundle.model.layout().tensors()) {
    if (tensor.name != "transition.0.bias") continue;
    const MatrixXd rows = V.middleRows(tensor.offset, 3);
    EXPECT_LT((rows * rows.transpose() - Eigen::Vector3d(4, 1, 0).asDiagonal().toDenseMatrix()).norm(), 1e-12);
  }
}

/// A linear system whose transition has an unknown offset.
struct UnknownOffset {
  LinearSystem system;
  nssm::Bundle bundle;
  MatrixXd V;  // of the offset of x

  explicit UnknownOffset(double std) : bundle(LinearBundle(system)) {
    bundle = WithPosterior(bundle, "transition.0.bias", std * std * Eigen::Vector3d(1, 0.5, 2).asDiagonal().toDenseMatrix());
    for (const nn::Tensor& tensor : bundle.model.layout().tensors()) {
      if (tensor.name == "transition.0.bias") V = UnknownDirections(bundle).middleRows(tensor.offset, 2);
    }
  }
  Ekf MakeFilter(const std::shared_ptr<FilterModel>& model) const { return *Ekf::Create(bundle, model, model->Prepare(bundle), {.gate = {.probability = 0}}); }
};

// Linear in [x; z]: there the filter is Kalman's.
TEST(UnknownParametersTest, WithAnUnknownOffsetItIsTheKalmanFilterOfStateAndOffset) {
  const UnknownOffset c(0.7);
  const Index r = c.V.cols(), n = 2 + r;
  ASSERT_EQ(r, 3);
  const std::shared_ptr<FilterModel> model = FilterModel::Create(c.bundle);
  const auto scratch = model->MakeScratch();
  Ekf ekf = c.MakeFilter(model);
  Estimate estimate = ekf.MakeEstimate();
  MatrixXd A = MatrixXd::Identity(n, n), C = MatrixXd::Zero(2, n), Q = MatrixXd::Zero(n, n), P = MatrixXd::Identity(n, n);
  A.topLeftCorner(2, 2) = c.system.A;
  A.topRightCorner(2, r) = c.V;
  C.leftCols(2) = c.system.C;
  Q.topLeftCorner(2, 2) = c.system.Q;
  P.topLeftCorner(2, 2) = c.system.P0;
  VectorXd mean = VectorXd::Zero(n);
  LinearTruth truth(c.system, 4);
  const Eigen::Vector2d offset(0.6, -0.4);
  double u = 0;
  for (int t = 0; t < 300; ++t) {
    const VectorXd y = truth.Measure();
    if (t > 0) {
      mean = A * mean;
      mean.head(2) += c.system.B * u;
      P = A * P * A.transpose() + Q;
    }
    u = truth.rng.Normal();
    const MatrixXd K = P * C.transpose() * (C * P * C.transpose() + c.system.R).inverse();
    mean += K * (y - C * mean);
    P = (MatrixXd::Identity(n, n) - K * C) * P;
    ASSERT_TRUE(ekf.Step(VectorXd::Constant(1, u), y, scratch.get(), &estimate).ok());
    ASSERT_LT((estimate.mean - mean.head(2)).norm(), 1e-10 * (1 + mean.norm())) << t;
    ASSERT_LT((estimate.cov - P.topLeftCorner(2, 2)).norm(), 1e-10) << t;
    ASSERT_LT((ekf.state().mean - mean).norm(), 1e-9 * (1 + mean.norm())) << t;
    truth.Advance(u);
    truth.state += offset;
  }
  // It has found the offset.
  EXPECT_LT((c.V * ekf.state().mean.tail(r) - offset).norm(), 0.1);
}

TEST(UnknownParametersTest, WhatIsNotKnownWidensBoundsAndWhatIsDoesNot) {
  const auto variances = [](double std) {
    const UnknownOffset c(std);
    const std::shared_ptr<FilterModel> model = FilterModel::Create(c.bundle);
    const auto scratch = model->MakeScratch();
    Ekf ekf = c.MakeFilter(model);
    Estimate estimate = ekf.MakeEstimate();
    LinearTruth truth(c.system, 4);
    for (int t = 0; t < 5; ++t) {
      EXPECT_TRUE(ekf.Step(VectorXd::Zero(1), truth.Measure(), scratch.get(), &estimate).ok());
      truth.Advance(0);
    }
    return VectorXd(estimate.cov.diagonal());
  };
  const VectorXd plain = variances(1e-9), little = variances(0.1), much = variances(1);
  Filter known(LinearBundle(LinearSystem()));
  LinearTruth truth(LinearSystem(), 4);
  for (int t = 0; t < 5; ++t) {
    ASSERT_TRUE(known.ekf.Step(VectorXd::Zero(1), truth.Measure(), known.scratch.get(), &known.estimate).ok());
    truth.Advance(0);
  }
  EXPECT_LT((plain - known.estimate.cov.diagonal()).norm(), 1e-12);
  for (Index i = 0; i < 2; ++i) {
    EXPECT_GT(little[i], plain[i]);
    EXPECT_GT(much[i], little[i]);
  }
}

// Of every kind of model, with gates, constraints and samples without measurement: estimates stay finite, inside, and semidefinite.
TEST(UnknownParametersTest, EveryKindOfModelIsFollowedWithUnknownParameters) {
  for (const nssm::ModelCase& c : nssm::ModelCases()) {
    SCOPED_TRACE(c.name);
    nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(c.model));
    bundle.parameters = nssm::RandomParameters(bundle.model, 5);
    const Index p = bundle.model.layout().size();
    bundle = WithPosterior(bundle, "*", 1e-4 * MatrixXd::Identity(p, p));
    const std::shared_ptr<FilterModel> model = FilterModel::Create(bundle);
    const auto scratch = model->MakeScratch();
    absl::StatusOr<Ekf> ekf = Ekf::Create(bundle, model, model->Prepare(bundle), {});
    ASSERT_TRUE(ekf.ok()) << ekf.status();
    Estimate estimate = ekf->MakeEstimate();
    base::Rng rng(2);
    for (int t = 0; t < 30; ++t) {
      VectorXd y = RandomVector(&rng, c.model.output_size);
      if (t % 7 == 6) y.setConstant(std::numeric_limits<double>::quiet_NaN());
      ASSERT_TRUE(ekf->Step(RandomVector(&rng, c.model.input_size), y, scratch.get(), &estimate).ok());
      if (estimate.health == Health::kWarmingUp) continue;
      ASSERT_TRUE(estimate.mean.allFinite()) << t;
      ASSERT_EQ(estimate.cov, estimate.cov.transpose());
      ASSERT_GE(estimate.cov.diagonal().minCoeff(), 0);
      const physics::Polyhedron* const set = bundle.model.state_set();
      ASSERT_TRUE(set == nullptr || physics::Contains(*set, estimate.mean)) << t;
    }
  }
}

}  // namespace
}  // namespace metaekf::filter
