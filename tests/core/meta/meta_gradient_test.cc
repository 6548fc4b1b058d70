#include "core/meta/meta_gradient.h"

#include <gtest/gtest.h>

#include "tests/core/nssm/random_models.h"

namespace metaekf::meta {
namespace {

using nssm::LossData;
using nssm::LossShape;
using nssm::ModelCase;

struct Task {
  nssm::Model model;
  LossShape shape;
  LossData<double> context, target;
  std::vector<double> parameters;
};

Task MakeTask(const ModelCase& c) {
  nssm::Model model = *nssm::Model::Create(c.model);
  const LossShape shape = *nssm::ShapeOfLoss(c.model, c.loss, 9);
  const data::Trajectory trajectory = nssm::RandomTrajectory(c.model, 30, 3);
  LossData<double> context = nssm::CutLossData<double>(c.model, c.loss, trajectory, 1, shape);
  LossData<double> target = nssm::CutLossData<double>(c.model, c.loss, trajectory, 17, shape);
  std::vector<double> parameters = nssm::RandomParameters(model, 7);
  return {std::move(model), shape, std::move(context), std::move(target), std::move(parameters)};
}

double RelativeErrorAgainstDifferences(const ModelCase& c, const std::string& mask_text, int32_t steps) {
  const Task task = MakeTask(c);
  const nn::Mask mask = *nn::ParseMask(mask_text, task.model.layout());
  const MetaGradient<double> meta(task.model, c.loss, Algorithm::kMaml, task.shape, task.shape, mask, steps, 0.05);
  MetaGradient<double>::Scratch scratch(meta);
  const size_t n = task.parameters.size();
  std::vector<double> gradient(n);
  meta.Compute(task.parameters.data(), task.context, task.target, gradient.data(), &scratch);
  double error = 0, norm = 0;
  const double h = 1e-4;
  for (size_t i = 0; i < n; ++i) {
    // Fourth-order central difference.
    const auto loss_at = [&](double shift) {
      std::vector<double> moved = task.parameters;
      moved[i] += shift;
      return meta.TargetLoss(moved.data(), task.context, task.target, &scratch);
    };
    const double fd = (8 * (loss_at(h) - loss_at(-h)) - (loss_at(2 * h) - loss_at(-2 * h))) / (12 * h);
    error += (gradient[i] - fd) * (gradient[i] - fd);
    norm += fd * fd;
  }
  return std::sqrt(error / norm);
}

TEST(MetaGradientTest, SecondOrderMatchesCentralDifferencesForEveryKindOfModel) {
  for (const ModelCase& c : nssm::ModelCases()) {
    if (!c.smooth) continue;
    EXPECT_LT(RelativeErrorAgainstDifferences(c, "*", 3), 1e-6) << c.name;
  }
}

TEST(MetaGradientTest, SecondOrderMatchesCentralDifferencesWithMasks) {
  for (const ModelCase& c : nssm::ModelCases()) {
    if (!c.smooth) continue;
    for (const char* mask : {"*_decoder", "encoder.0,transition", "encoder.0.weight"}) {
      EXPECT_LT(RelativeErrorAgainstDifferences(c, mask, 2), 1e-6) << c.name << ", mask " << mask;
    }
  }
}

// The mistake of computing the target loss on the unadapted model would make both losses equal, and the
// meta-gradient the plain gradient of the target loss.
TEST(MetaGradientTest, TheTargetLossIsThatOfTheAdaptedModel) {
  const ModelCase c = nssm::ModelCases().front();
  const Task task = MakeTask(c);
  const nn::Mask all(task.model.layout().tensors().size(), true);
  const auto loss_of = [&](Algorithm algorithm, std::vector<double>* gradient) {
    const MetaGradient<double> meta(task.model, c.loss, algorithm, task.shape, task.shape, all, 5, 0.1);
    MetaGradient<double>::Scratch scratch(meta);
    gradient->resize(task.parameters.size());
    return meta.Compute(task.parameters.data(), task.context, task.target, gradient->data(), &scratch);
  };
  std::vector<double> maml, plain;
  const double adapted = loss_of(Algorithm::kMaml, &maml), unadapted = loss_of(Algorithm::kSupervised, &plain);
  EXPECT_GT(std::abs(adapted - unadapted), 0.01 * unadapted);
  double difference = 0, norm = 0;
  for (size_t i = 0; i < maml.size(); ++i) {
    difference += (maml[i] - plain[i]) * (maml[i] - plain[i]);
    norm += plain[i] * plain[i];
  }
  EXPECT_GT(difference, 0.01 * norm);
  // By hand: five gradient steps on the context loss, then the target loss.
  const nssm::LossFunction<double> loss(task.model, c.loss, task.shape, all, all);
  const auto scratch = loss.MakeScratch();
  std::vector<double> parameters = task.parameters, gradient(parameters.size());
  for (int m = 0; m < 5; ++m) {
    loss.Gradient(parameters.data(), task.context, gradient.data(), scratch);
    for (size_t i = 0; i < parameters.size(); ++i) parameters[i] -= 0.1 * gradient[i];
  }
  EXPECT_DOUBLE_EQ(adapted, loss.Value(parameters.data(), task.target, scratch));
}

TEST(MetaGradientTest, FirstOrderIsTheTargetGradientAtTheAdaptedModel) {
  const ModelCase c = nssm::ModelCases().front();
  const Task task = MakeTask(c);
  const nn::Mask all(task.model.layout().tensors().size(), true);
  const MetaGradient<double> meta(task.model, c.loss, Algorithm::kFirstOrderMaml, task.shape, task.shape, all, 2, 0.1);
  MetaGradient<double>::Scratch scratch(meta);
  std::vector<double> result(task.parameters.size()), gradient(result.size()), parameters = task.parameters;
  meta.Compute(task.parameters.data(), task.context, task.target, result.data(), &scratch);
  const nssm::LossFunction<double> loss(task.model, c.loss, task.shape, all, all);
  const auto loss_scratch = loss.MakeScratch();
  for (int m = 0; m < 2; ++m) {
    loss.Gradient(parameters.data(), task.context, gradient.data(), loss_scratch);
    for (size_t i = 0; i < parameters.size(); ++i) parameters[i] -= 0.1 * gradient[i];
  }
  loss.Gradient(parameters.data(), task.target, gradient.data(), loss_scratch);
  EXPECT_EQ(result, gradient);
}

TEST(MetaGradientTest, AnilWithTheFullMaskIsMamlBitForBit) {
  const ModelCase c = nssm::ModelCases().front();
  const Task task = MakeTask(c);
  std::vector<std::vector<double>> gradients;
  for (const char* mask : {"*", "encoder,transition*,output_decoder"}) {
    const MetaGradient<double> meta(task.model, c.loss, Algorithm::kMaml, task.shape, task.shape,
                                    *nn::ParseMask(mask, task.model.layout()), 3, 0.1);
    MetaGradient<double>::Scratch scratch(meta);
    gradients.emplace_back(task.parameters.size());
    meta.Compute(task.parameters.data(), task.context, task.target, gradients.back().data(), &scratch);
  }
  EXPECT_EQ(gradients[0], gradients[1]);
}

}  // namespace
}  // namespace metaekf::meta
