#include "core/meta/meta_gradient.h"

#include <gtest/gtest.h>

#include <cmath>

#include "core/base/numbers.h"
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

TrainingSpec Spec(const ModelCase& c, Algorithm algorithm, int32_t steps, double learning_rate) {
  TrainingSpec spec{.loss = c.loss, .algorithm = algorithm};
  spec.inner_loop.steps = steps;
  spec.inner_loop.learning_rate = learning_rate;
  return spec;
}

/// ω, and rates around `rate` that all differ.
std::vector<double> Variables(const Task& task, const MetaGradient<double>& meta, double rate) {
  std::vector<double> variables = task.parameters;
  for (size_t l = 0; variables.size() < meta.variables(); ++l) {
    variables.push_back(std::log(rate * (1 + 0.1 * static_cast<double>(l))));
  }
  return variables;
}

/// Relative error of the meta-gradient against fourth-order central differences of step h.
double RelativeErrorAgainstDifferences(const ModelCase& c, const std::string& mask_text, const TrainingSpec& spec, double h) {
  const Task task = MakeTask(c);
  const nn::Mask mask = *nn::ParseMask(mask_text, task.model.layout());
  const MetaGradient<double> meta(task.model, spec, task.shape, task.shape, mask);
  MetaGradient<double>::Scratch scratch(meta);
  const std::vector<double> variables = Variables(task, meta, spec.inner_loop.learning_rate);
  std::vector<double> gradient(variables.size());
  meta.Compute(variables.data(), task.context, task.target, gradient.data(), &scratch);
  double error = 0, norm = 0;
  for (size_t i = 0; i < variables.size(); ++i) {
    const auto loss_at = [&](double shift) {
      std::vector<double> moved = variables;
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
  double worst = 0;
  for (const ModelCase& c : nssm::ModelCases()) {
    if (!c.smooth) continue;
    const double error = RelativeErrorAgainstDifferences(c, "*", Spec(c, Algorithm::kMaml, 3, 0.05), 1e-4);
    EXPECT_LT(error, 1e-6) << c.name;
    worst = std::max(worst, error);
  }
  RecordProperty("worst", base::FormatShort(worst));
}

TEST(MetaGradientTest, SecondOrderMatchesCentralDifferencesWithMasks) {
  for (const ModelCase& c : nssm::ModelCases()) {
    if (!c.smooth) continue;
    for (const char* mask : {"*_decoder", "encoder.0,transition", "encoder.0.weight"}) {
      EXPECT_LT(RelativeErrorAgainstDifferences(c, mask, Spec(c, Algorithm::kMaml, 2, 0.05), 1e-4), 1e-6)
          << c.name << ", mask " << mask;
    }
  }
}

// Few samples and wide layers: the inner loop's gradients record their activations.
TEST(MetaGradientTest, SecondOrderFromRecordsMatchesCentralDifferences) {
  for (size_t index : {size_t{0}, size_t{7}, size_t{11}}) {
    ModelCase c = nssm::ModelCases()[index];
    c.model.latent_size = 6;
    c.model.encoder.hidden_widths = c.model.transition.block.hidden_widths = {14};
    c.loss.stride = 9;  // one rollout
    for (const char* mask : {"*", "transition,*_decoder"}) {
      const TrainingSpec spec = Spec(c, Algorithm::kMaml, 3, 0.05);
      const Task task = MakeTask(c);
      EXPECT_TRUE(MetaGradient<double>(task.model, spec, task.shape, task.shape, *nn::ParseMask(mask, task.model.layout())).records());
      EXPECT_LT(RelativeErrorAgainstDifferences(c, mask, spec, 1e-4), 1e-6) << c.name << ", mask " << mask;
    }
  }
}

// Adam's first steps turn with the sign of a gradient, so the differences must be finer than the gradients.
TEST(MetaGradientTest, SecondOrderThroughAdamAndItsRatesMatchesCentralDifferences) {
  double worst = 0;
  for (const ModelCase& c : nssm::ModelCases()) {
    if (!c.smooth) continue;
    for (const char* mask : {"*", "encoder.0,transition"}) {
      for (const bool learned_rates : {false, true}) {
        TrainingSpec spec = Spec(c, Algorithm::kMaml, 4, 0.02);
        spec.inner_loop.optimiser = Optimiser::kAdam;
        spec.inner_loop.learned_rates = learned_rates;
        const double error = RelativeErrorAgainstDifferences(c, mask, spec, 1e-6);
        EXPECT_LT(error, 1e-6) << c.name << ", mask " << mask;
        worst = std::max(worst, error);
      }
    }
  }
  RecordProperty("worst", base::FormatShort(worst));
}

TEST(MetaGradientTest, LearnedRatesMatchCentralDifferences) {
  double worst = 0;
  for (const ModelCase& c : nssm::ModelCases()) {
    if (!c.smooth) continue;
    for (const char* mask : {"*", "*_decoder"}) {
      TrainingSpec spec = Spec(c, Algorithm::kMaml, 3, 0.05);
      spec.inner_loop.learned_rates = true;
      const double error = RelativeErrorAgainstDifferences(c, mask, spec, 1e-4);
      EXPECT_LT(error, 1e-6) << c.name << ", mask " << mask;
      worst = std::max(worst, error);
    }
  }
  RecordProperty("worst", base::FormatShort(worst));
}

// With an inner loop that has come to rest the differences are those of the minimum itself.
TEST(MetaGradientTest, TheImplicitGradientMatchesCentralDifferencesOfTheMinimum) {
  double worst = 0;
  for (const auto& [index, mask] : {std::pair{0, "encoder.0,transition"}, {5, "*"}}) {
    const ModelCase c = nssm::ModelCases()[static_cast<size_t>(index)];
    TrainingSpec spec = Spec(c, Algorithm::kImplicitMaml, 600, 0.1);
    spec.inner_loop.proximal = 2;
    spec.implicit_maml = {.cg_steps = 300, .cg_tolerance = 1e-13};
    const double error = RelativeErrorAgainstDifferences(c, mask, spec, 1e-3);
    EXPECT_LT(error, 1e-6) << c.name << ", mask " << mask;
    worst = std::max(worst, error);
  }
  RecordProperty("worst", base::FormatShort(worst));
}

// The differences are those of the whole way: fit, Newton steps, loss of the target set.
TEST(MetaGradientTest, TheImplicitGradientAtALeastSquaresMinimumMatchesCentralDifferences) {
  double worst = 0;
  for (const auto& [index, mask] : {std::pair{0, "encoder.0,transition"}, {1, "*"}, {2, "*_decoder"}, {5, "*"}}) {
    ModelCase c = nssm::ModelCases()[static_cast<size_t>(index)];
    c.loss.reconstruction_weight = 0;
    TrainingSpec spec = Spec(c, Algorithm::kImplicitMaml, 60, 0);
    spec.inner_loop.optimiser = Optimiser::kLevenbergMarquardt;
    spec.inner_loop.proximal = 2;
    spec.implicit_maml = {.cg_steps = 300, .cg_tolerance = 1e-13};
    const double error = RelativeErrorAgainstDifferences(c, mask, spec, 1e-3);
    EXPECT_LT(error, 1e-6) << c.name << ", mask " << mask;
    worst = std::max(worst, error);
  }
  RecordProperty("worst", base::FormatShort(worst));
}

TEST(MetaGradientTest, FirstOrderRatesTakeTheDirectionsForConstants) {
  const ModelCase c = nssm::ModelCases().front();
  const Task task = MakeTask(c);
  const nn::Mask all(task.model.layout().tensors().size(), true);
  TrainingSpec spec = Spec(c, Algorithm::kFirstOrderMaml, 3, 0.05);
  spec.inner_loop.learned_rates = true;
  const MetaGradient<double> meta(task.model, spec, task.shape, task.shape, all);
  MetaGradient<double>::Scratch scratch(meta);
  const std::vector<double> variables = Variables(task, meta, 0.05);
  std::vector<double> gradient(variables.size()), context_gradient(task.parameters.size()), total(task.parameters.size());
  meta.Compute(variables.data(), task.context, task.target, gradient.data(), &scratch);
  // By hand: the steps once more, their directions summed.
  const nssm::LossFunction<double> loss(task.model, c.loss, task.shape, all, all);
  auto loss_scratch = loss.MakeScratch();
  std::vector<double> parameters = task.parameters;
  for (int m = 0; m < 3; ++m) {
    loss.Gradient(parameters.data(), task.context, context_gradient.data(), &loss_scratch);
    for (size_t l = 0; l < all.size(); ++l) {
      const nn::Tensor& tensor = task.model.layout().tensors()[l];
      for (int64_t k = tensor.offset; k < tensor.offset + tensor.size(); ++k) {
        const size_t i = static_cast<size_t>(k);
        parameters[i] -= std::exp(variables[total.size() + l]) * context_gradient[i];
        total[i] += context_gradient[i];
      }
    }
  }
  for (size_t l = 0; l < all.size(); ++l) {
    const nn::Tensor& tensor = task.model.layout().tensors()[l];
    double expected = 0;
    for (int64_t k = tensor.offset; k < tensor.offset + tensor.size(); ++k) {
      expected -= gradient[static_cast<size_t>(k)] * total[static_cast<size_t>(k)] * std::exp(variables[total.size() + l]);
    }
    EXPECT_NEAR(gradient[total.size() + l], expected, 1e-12) << tensor.name;
  }
}

// The mistake of computing the target loss on the unadapted model would make both losses equal, and the
// meta-gradient the plain gradient of the target loss.
TEST(MetaGradientTest, TheTargetLossIsThatOfTheAdaptedModel) {
  const ModelCase c = nssm::ModelCases().front();
  const Task task = MakeTask(c);
  const nn::Mask all(task.model.layout().tensors().size(), true);
  const auto loss_of = [&](Algorithm algorithm, std::vector<double>* gradient) {
    const MetaGradient<double> meta(task.model, Spec(c, algorithm, 5, 0.1), task.shape, task.shape, all);
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
  auto scratch = loss.MakeScratch();
  std::vector<double> parameters = task.parameters, gradient(parameters.size());
  for (int m = 0; m < 5; ++m) {
    loss.Gradient(parameters.data(), task.context, gradient.data(), &scratch);
    for (size_t i = 0; i < parameters.size(); ++i) parameters[i] -= 0.1 * gradient[i];
  }
  EXPECT_DOUBLE_EQ(adapted, loss.Value(parameters.data(), task.target, &scratch));
}

TEST(MetaGradientTest, FirstOrderIsTheTargetGradientAtTheAdaptedModel) {
  const ModelCase c = nssm::ModelCases().front();
  const Task task = MakeTask(c);
  const nn::Mask all(task.model.layout().tensors().size(), true);
  const MetaGradient<double> meta(task.model, Spec(c, Algorithm::kFirstOrderMaml, 2, 0.1), task.shape, task.shape, all);
  MetaGradient<double>::Scratch scratch(meta);
  std::vector<double> result(task.parameters.size()), gradient(result.size()), parameters = task.parameters;
  meta.Compute(task.parameters.data(), task.context, task.target, result.data(), &scratch);
  const nssm::LossFunction<double> loss(task.model, c.loss, task.shape, all, all);
  auto loss_scratch = loss.MakeScratch();
  for (int m = 0; m < 2; ++m) {
    loss.Gradient(parameters.data(), task.context, gradient.data(), &loss_scratch);
    for (size_t i = 0; i < parameters.size(); ++i) parameters[i] -= 0.1 * gradient[i];
  }
  loss.Gradient(parameters.data(), task.target, gradient.data(), &loss_scratch);
  EXPECT_EQ(result, gradient);
}

TEST(MetaGradientTest, AnilWithTheFullMaskIsMamlBitForBit) {
  const ModelCase c = nssm::ModelCases().front();
  const Task task = MakeTask(c);
  std::vector<std::vector<double>> gradients;
  for (const char* mask : {"*", "encoder,transition*,output_decoder"}) {
    const MetaGradient<double> meta(task.model, Spec(c, Algorithm::kMaml, 3, 0.1), task.shape, task.shape,
                                    *nn::ParseMask(mask, task.model.layout()));
    MetaGradient<double>::Scratch scratch(meta);
    gradients.emplace_back(task.parameters.size());
    meta.Compute(task.parameters.data(), task.context, task.target, gradients.back().data(), &scratch);
  }
  EXPECT_EQ(gradients[0], gradients[1]);
}

}  // namespace
}  // namespace metaekf::meta
