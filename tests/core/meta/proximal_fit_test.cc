#include "core/meta/proximal_fit.h"

#include <gtest/gtest.h>

#include <cmath>

#include "core/base/numbers.h"
#include "tests/core/nssm/random_models.h"

namespace metaekf::meta {
namespace {

using Eigen::Index;
using Eigen::VectorXd;

/// One system of a kind of model, as least squares and as the loss of training.
struct Task {
  Task(nssm::ModelCase given, const std::string& mask_text)
      : c(std::move(given)), model(*nssm::Model::Create(c.model)), mask(*nn::ParseMask(mask_text, model.layout())) {
    c.loss.reconstruction_weight = 0;
    problem.emplace(model, c.loss, mask, false);
    data = *problem->Cut(nssm::RandomTrajectory(c.model, 20, 5));
    workspace.emplace(*problem, data.shape);
    loss.emplace(model, c.loss, data.shape, mask, mask);
    start = nssm::RandomParameters(model, 9);
  }
  MapFit Fit(const ProximalFitOptions& options) { return FitProximal(*problem, c.loss, data, start, options, &*workspace); }
  std::vector<double> At(const VectorXd& adapted) const {
    std::vector<double> parameters = start;
    ScatterAdapted(*problem, adapted, &parameters);
    return parameters;
  }

  nssm::ModelCase c;
  nssm::Model model;
  nn::Mask mask;
  std::optional<nssm::RolloutLeastSquares> problem;
  nssm::LossData<double> data;
  std::optional<nssm::RolloutLeastSquares::Workspace> workspace;
  std::optional<nssm::LossFunction<double>> loss;
  std::vector<double> start;
};

TEST(ProximalFitTest, TheCostIsTheLossAndThePullForEveryKindOfModel) {
  for (const nssm::ModelCase& c : nssm::ModelCases()) {
    Task task(c, "*");
    const MapFit fit = task.Fit({.proximal = 3, .steps = 2});
    auto scratch = task.loss->MakeScratch();
    const double loss = task.loss->Value(task.At(fit.unknowns).data(), task.data, &scratch);
    const double distance = (fit.unknowns - GatherAdapted(*task.problem, task.start)).norm();
    EXPECT_NEAR(fit.cost, loss + 1.5 * distance * distance, 1e-12 * fit.cost) << c.name;
  }
}

// By the gradient of the loss that training computes, which knows nothing of least squares.
TEST(ProximalFitTest, TheMinimumIsStationaryForEveryKindOfModel) {
  double worst = 0;
  for (const nssm::ModelCase& c : nssm::ModelCases()) {
    if (!c.smooth) continue;
    for (const char* mask : {"*", "encoder.0,transition"}) {
      Task task(c, mask);
      const MapFit fit = task.Fit({.proximal = 2, .steps = 60});
      EXPECT_TRUE(fit.converged) << c.name;
      std::vector<double> gradient(task.start.size());
      auto scratch = task.loss->MakeScratch();
      task.loss->Gradient(task.At(fit.unknowns).data(), task.data, gradient.data(), &scratch);
      const VectorXd pull = 2 * (fit.unknowns - GatherAdapted(*task.problem, task.start));
      const double rest = (GatherAdapted(*task.problem, gradient) + pull).norm() / pull.norm();
      EXPECT_LT(rest, 1e-3) << c.name << ", mask " << mask;
      worst = std::max(worst, rest);
    }
  }
  RecordProperty("worst", base::FormatShort(worst));
}

TEST(ProximalFitTest, AChannelWithoutWeightIsNotLookedAt) {
  nssm::ModelCase c = nssm::ModelCases()[1];
  c.loss.state_weight = 0;
  Task task(c, "*");
  const VectorXd variance = VarianceOfLoss(*task.problem, task.c.loss, task.data);
  EXPECT_TRUE(std::isinf(variance[0]) && std::isinf(variance[1]));
  EXPECT_TRUE(std::isfinite(variance[2]) && std::isfinite(variance[3]));
  const VectorXd before = task.Fit({.steps = 5}).unknowns;
  for (double& value : task.data.states) value = 1e3;
  EXPECT_EQ(task.Fit({.steps = 5}).unknowns, before);
}

TEST(ProximalFitTest, AnInfinitePullStaysAtTheStart) {
  Task task(nssm::ModelCases().front(), "*");
  EXPECT_LT((task.Fit({.proximal = 1e14}).unknowns - GatherAdapted(*task.problem, task.start)).norm(), 1e-10);
}

}  // namespace
}  // namespace metaekf::meta
