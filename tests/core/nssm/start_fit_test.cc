#include "core/nssm/start_fit.h"

#include <gtest/gtest.h>

#include <cmath>

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include "core/base/rng.h"
#include "core/nssm/linearise.h"
#include "tests/core/nssm/random_models.h"

namespace metaekf::nssm {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr Index kWindow = 12;

ModelSpec FittedSpec(InputTime input_time) {
  ModelSpec spec = ModelCases().front().model;
  spec.start = StartMode::kFitted;
  spec.window = kWindow;
  spec.transition.form = TransitionForm::kJoint;
  spec.transition.bypass = Bypass::kLinear;
  spec.transition.input_time = input_time;
  spec.output_decoder.hidden_widths.clear();
  return spec;
}

GaussianPrior Prior(const Model& model, double precision) {
  const Index n = model.spec().latent_size;
  return {.start = precision * MatrixXd::Identity(n, n),
          .start_guess = MatrixXd::Zero(n, model.start_size() + 1),
          .noise_variance = VectorXd::LinSpaced(model.spec().output_size, 0.5, 2)};
}

/// A model that forgets where it began.
std::vector<double> StableParameters(const Model& model) {
  std::vector<double> parameters = RandomParameters(model, 5);
  for (double& value : parameters) value *= 0.5;
  return parameters;
}

/// Of data that the model itself has made: a fit ends where the noise says that it is close, so there must be next to none.
GaussianPrior ExactPrior(const Model& model) {
  GaussianPrior prior = Prior(model, 1e-12);
  prior.noise_variance *= 1e-18;
  return prior;
}

/// A window that the model itself has made from ψ_s, and where it ends.
struct Made {
  Made(const Model& model, const std::vector<double>& parameters, uint64_t seed, double noise) {
    base::Rng rng(seed);
    const ModelSpec& spec = model.spec();
    const Index n_u = spec.input_size, n_y = spec.output_size, shift = spec.transition.input_time == InputTime::kNext ? 1 : 0;
    window = MatrixXd::Zero(n_u + n_y, kWindow);
    for (Index i = 0; i < n_u * kWindow; ++i) window(i % n_u, i / n_u) = rng.Normal();
    end = VectorXd::Zero(spec.latent_size);
    for (double& value : end) value = rng.Normal();
    start = end;
    for (Index k = 0; k + 1 < kWindow; ++k) {
      const VectorXd u = window.col(k + shift).head(n_u);
      end = Linearise(model, parameters, end, u).f;
      window.col(k + 1).tail(n_y) = Linearise(model, parameters, end, u).h;
      for (Index i = 0; i < n_y; ++i) window(n_u + i, k + 1) += noise * rng.Normal();
    }
  }
  MatrixXd window;
  VectorXd start, end;
};

TEST(StartFitTest, FindsTheEndOfATrajectoryThatTheModelMade) {
  for (const InputTime input_time : {InputTime::kCurrent, InputTime::kNext}) {
    const Model model = *Model::Create(FittedSpec(input_time));
    const std::vector<double> parameters = RandomParameters(model, 5);
    for (uint64_t seed = 0; seed < 10; ++seed) {
      const Made made(model, parameters, seed, 0);
      GaussianPrior prior = ExactPrior(model);
      prior.start_guess.rightCols(1) = made.start + VectorXd::Constant(made.start.size(), 0.2);
      StartFit fit(model, prior, 1);
      EXPECT_LT((fit.Fit(parameters.data(), made.window.reshaped()).col(0) - made.end).norm(), 1e-6 * made.end.norm());
    }
  }
}

TEST(StartFitTest, ALinearModelsStartIsBayesianLinearRegressions) {
  constexpr double kSure = 1e6;  // a minimum is found the more closely, the deeper it is
  ModelSpec spec = FittedSpec(InputTime::kNext);
  spec.transition.block.hidden_widths.clear();  // f is linear
  const Model model = *Model::Create(spec);
  const std::vector<double> parameters = RandomParameters(model, 6);
  GaussianPrior prior = Prior(model, 0.7 * kSure);
  prior.noise_variance /= kSure;
  const Made made(model, parameters, 3, 0.5 / std::sqrt(kSure));
  // y_k = C ψ_k + d with ψ_k = A^k ψ_s + …: the regression by its definition.
  const Index n = spec.latent_size, n_y = spec.output_size, n_u = spec.input_size;
  MatrixXd information = prior.start, power = MatrixXd::Identity(n, n);
  VectorXd right = VectorXd::Zero(n), offset = VectorXd::Zero(n);
  const VectorXd weights = prior.noise_variance.cwiseInverse();
  for (Index k = 1; k < kWindow; ++k) {
    const Linearisation l = Linearise(model, parameters, offset, made.window.col(k).head(n_u));
    power = l.A * power;
    offset = l.f;
    const Linearisation out = Linearise(model, parameters, offset, made.window.col(k).head(n_u));
    const MatrixXd rows = out.C * power;
    information += rows.transpose() * weights.asDiagonal() * rows;
    right += rows.transpose() * weights.cwiseProduct(made.window.col(k).tail(n_y) - out.h);
  }
  const VectorXd start = information.llt().solve(right);
  StartFit fit(model, prior, 1);
  EXPECT_LT((fit.Fit(parameters.data(), made.window.reshaped()).col(0) - (power * start + offset)).norm(), 1e-6);
  EXPECT_LT((fit.Covariance() - power * information.inverse() * power.transpose()).norm() * kSure, 1e-9);
}

// 80 windows are three stretches: in one place after the other, or each in its own.
TEST(StartFitTest, TheNumberOfPlacesChangesNothing) {
  constexpr Index kCount = 80;
  const Model model = *Model::Create(FittedSpec(InputTime::kNext));
  const std::vector<double> parameters = RandomParameters(model, 5);
  MatrixXd windows(model.start_size(), kCount);
  for (Index j = 0; j < kCount; ++j) windows.col(j) = Made(model, parameters, static_cast<uint64_t>(j), 0.3).window.reshaped();
  const MatrixXd one = StartFit(model, Prior(model, 0.1), 1).Fit(parameters.data(), windows);
  for (const int32_t width : {2, 5}) {
    const MatrixXd together = StartFit(model, Prior(model, 0.1), width).Fit(parameters.data(), windows);
    EXPECT_LT((together - one).norm(), 1e-12 * one.norm()) << width;
  }
}

TEST(StartFitTest, FollowsARecordingSampleBySample) {
  constexpr Index kLength = 100;
  const Model model = *Model::Create(FittedSpec(InputTime::kNext));
  const std::vector<double> parameters = StableParameters(model);
  const ModelSpec& spec = model.spec();
  base::Rng rng(4);
  MatrixXd recording(spec.input_size + spec.output_size, kLength), latents(spec.latent_size, kLength);
  for (double& value : recording.reshaped()) value = rng.Normal();
  latents.col(0).setConstant(0.5);
  for (Index k = 1; k < kLength; ++k) {
    const VectorXd u = recording.col(k).head(spec.input_size);
    latents.col(k) = Linearise(model, parameters, latents.col(k - 1), u).f;
    recording.col(k).tail(spec.output_size) = Linearise(model, parameters, latents.col(k), u).h;
  }
  MatrixXd windows(model.start_size(), kLength - kWindow + 1);
  for (Index j = 0; j < windows.cols(); ++j) windows.col(j) = recording.middleCols(j, kWindow).reshaped();
  const MatrixXd found = StartFit(model, ExactPrior(model), 3).Fit(parameters.data(), windows);
  EXPECT_LT((found - latents.rightCols(windows.cols())).colwise().norm().maxCoeff(), 1e-6);
}

// What comes after is nothing that the window before it had told of.
TEST(StartFitTest, AWindowThatDoesNotFollowIsFittedAllTheSame) {
  constexpr Index kCount = 40;
  const Model model = *Model::Create(FittedSpec(InputTime::kNext));
  const std::vector<double> parameters = StableParameters(model);
  MatrixXd windows(model.start_size(), kCount), ends(model.spec().latent_size, kCount);
  for (Index j = 0; j < kCount; ++j) {
    const Made made(model, parameters, static_cast<uint64_t>(j), 0);
    windows.col(j) = made.window.reshaped();
    ends.col(j) = made.end;
  }
  const MatrixXd found = StartFit(model, ExactPrior(model), 2).Fit(parameters.data(), windows);
  EXPECT_LT((found - ends).colwise().norm().maxCoeff(), 1e-6);
}

TEST(StartFitTest, AGuessOfOtherLatentsDoesNoHarm) {
  const Model model = *Model::Create(FittedSpec(InputTime::kNext));
  const std::vector<double> parameters = RandomParameters(model, 5);
  GaussianPrior prior = ExactPrior(model);
  StartFit unaided(model, prior, 1);
  prior.start_guess.rightCols(1).setConstant(1e6);
  StartFit misled(model, prior, 1);
  for (uint64_t seed = 0; seed < 10; ++seed) {
    const MatrixXd window = Made(model, parameters, seed, 0).window.reshaped();
    const VectorXd expected = unaided.Fit(parameters.data(), window).col(0);
    EXPECT_LT((misled.Fit(parameters.data(), window).col(0) - expected).norm(), 1e-9) << seed;
  }
}

}  // namespace
}  // namespace metaekf::nssm
