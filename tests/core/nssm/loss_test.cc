#include "core/nssm/loss.h"

#include <gtest/gtest.h>

#include "core/base/rng.h"
#include "tests/core/nssm/random_models.h"

namespace metaekf::nssm {
namespace {

struct Problem {
  Model model;
  LossShape shape;
  LossData<double> data;
  std::vector<double> parameters;
};

Problem MakeProblem(const ModelCase& c, int64_t samples = 9) {
  Model model = *Model::Create(c.model);
  const LossShape shape = *ShapeOfLoss(c.model, c.loss, samples);
  LossData<double> data = CutLossData<double>(c.model, c.loss, RandomTrajectory(c.model, samples + 2, 3), 1, shape);
  std::vector<double> parameters = RandomParameters(model, 7);
  return {std::move(model), shape, std::move(data), std::move(parameters)};
}

nn::Mask All(const Model& model) { return nn::Mask(model.layout().tensors().size(), true); }

double Norm(const std::vector<double>& v) {
  double sum = 0;
  for (const double value : v) sum += value * value;
  return std::sqrt(sum);
}

TEST(LossTest, GradientsMatchCentralDifferencesForEveryKindOfModel) {
  for (const ModelCase& c : ModelCases()) {
    SCOPED_TRACE(c.name);
    const Problem p = MakeProblem(c);
    const LossFunction<double> loss(p.model, c.loss, p.shape, All(p.model), All(p.model));
    auto scratch = loss.MakeScratch();
    std::vector<double> gradient(p.parameters.size());
    const double value = loss.Gradient(p.parameters.data(), p.data, gradient.data(), &scratch);
    EXPECT_DOUBLE_EQ(value, loss.Value(p.parameters.data(), p.data, &scratch));
    const double h = 1e-5;
    for (size_t i = 0; i < gradient.size(); ++i) {
      std::vector<double> moved = p.parameters;
      moved[i] += h;
      const double up = loss.Value(moved.data(), p.data, &scratch);
      moved[i] -= 2 * h;
      const double down = loss.Value(moved.data(), p.data, &scratch);
      EXPECT_NEAR(gradient[i], (up - down) / (2 * h), 1e-7 * (1 + Norm(gradient))) << "parameter " << i;
    }
  }
}

TEST(LossTest, HessianVectorProductsMatchCentralDifferencesOfTheGradient) {
  for (const ModelCase& c : ModelCases()) {
    SCOPED_TRACE(c.name);
    const Problem p = MakeProblem(c);
    const LossFunction<double> loss(p.model, c.loss, p.shape, All(p.model), All(p.model));
    auto scratch = loss.MakeScratch();
    const size_t n = p.parameters.size();
    base::Rng rng(1);
    std::vector<double> v(n), product(n), up(n), down(n), moved(n);
    for (double& value : v) value = rng.Normal();
    loss.HessianVector(p.parameters.data(), p.data, v.data(), product.data(), &scratch);
    const double h = 1e-5;
    for (size_t i = 0; i < n; ++i) moved[i] = p.parameters[i] + h * v[i];
    loss.Gradient(moved.data(), p.data, up.data(), &scratch);
    for (size_t i = 0; i < n; ++i) moved[i] = p.parameters[i] - h * v[i];
    loss.Gradient(moved.data(), p.data, down.data(), &scratch);
    for (size_t i = 0; i < n; ++i) {
      EXPECT_NEAR(product[i], (up[i] - down[i]) / (2 * h), 1e-7 * (1 + Norm(product))) << "parameter " << i;
    }
  }
}

// Oracle: the same products from scratch.
TEST(LossTest, ProductsFromARecordAreThoseFromScratch) {
  size_t recorded = 0;
  for (const ModelCase& c : ModelCases()) {
    const Problem p = MakeProblem(c);
    for (const char* text : {"*", "transition,*_decoder", "encoder"}) {
      SCOPED_TRACE(c.name + ", along " + text);
      const nn::Mask along = *nn::ParseMask(text, p.model.layout());
      const LossFunction<double> scratch_loss(p.model, c.loss, p.shape, All(p.model), along);
      const LossFunction<double> masked_loss(p.model, c.loss, p.shape, along, along, HessianProducts::kNone);
      const LossFunction<double> recording(p.model, c.loss, p.shape, All(p.model), along, HessianProducts::kFromRecord);
      LossFunction<double>::Scratch scratch({&scratch_loss, &masked_loss, &recording});
      recorded += recording.record_size() > 0;
      const size_t n = p.parameters.size();
      base::Rng rng(1);
      std::vector<double> v(n), expected(n), gradient(n), product(n), record(static_cast<size_t>(recording.record_size()));
      for (double& value : v) value = rng.Normal();
      masked_loss.Gradient(p.parameters.data(), p.data, expected.data(), &scratch);
      recording.Gradient(p.parameters.data(), p.data, gradient.data(), &scratch, record.data());
      for (size_t i = 0; i < n; ++i) EXPECT_NEAR(gradient[i], expected[i], 1e-14 * (1 + Norm(expected))) << "parameter " << i;
      scratch_loss.HessianVector(p.parameters.data(), p.data, v.data(), expected.data(), &scratch);
      recording.HessianVector(p.parameters.data(), p.data, v.data(), product.data(), &scratch, record.data());
      for (size_t i = 0; i < n; ++i) EXPECT_NEAR(product[i], expected[i], 1e-13 * (1 + Norm(expected))) << "parameter " << i;
    }
  }
  EXPECT_EQ(recorded, 3 * ModelCases().size());
}

TEST(LossTest, AMaskedGradientIsTheFullOneRestricted) {
  const ModelCase c = ModelCases().front();
  const Problem p = MakeProblem(c);
  const nn::Mask mask = *nn::ParseMask("encoder.1,output_decoder", p.model.layout());
  const LossFunction<double> full(p.model, c.loss, p.shape, All(p.model), All(p.model));
  const LossFunction<double> masked(p.model, c.loss, p.shape, mask, mask);
  std::vector<double> a(p.parameters.size()), b(p.parameters.size(), 1);
  auto scratch = full.MakeScratch(), masked_scratch = masked.MakeScratch();
  full.Gradient(p.parameters.data(), p.data, a.data(), &scratch);
  masked.Gradient(p.parameters.data(), p.data, b.data(), &masked_scratch);
  for (size_t i = 0; i < mask.size(); ++i) {
    const nn::Tensor& tensor = p.model.layout().tensors()[i];
    for (int64_t k = tensor.offset; k < tensor.offset + tensor.size(); ++k) {
      EXPECT_DOUBLE_EQ(b[static_cast<size_t>(k)], mask[i] ? a[static_cast<size_t>(k)] : 0) << tensor.name;
    }
  }
}

// Oracle: the loss written out with loops and Eigen for a linear Case II model, straight from its definition.
TEST(LossTest, ALinearCaseTwoLossEqualsItsDefinition) {
  ModelSpec spec{.kind = Case::kStateInputOutput, .input_size = 1, .output_size = 1, .state_size = 2, .latent_size = 3, .window = 1};
  spec.precision = Precision::kFloat64;
  const LossSpec loss{.horizon = 2, .rollout = RolloutMode::kState, .stride = 3, .output_weight = 2, .state_weight = 3, .reconstruction_weight = 5};
  const Problem p = MakeProblem({"linear", spec, loss}, 12);
  const data::Trajectory d = RandomTrajectory(spec, 14, 3);
  const auto affine = [&p](const std::string& block, const Eigen::VectorXd& x) {
    Eigen::VectorXd y;
    for (const nn::Tensor& t : p.model.layout().tensors()) {
      const double* values = p.parameters.data() + t.offset;
      if (t.name == block + ".0.weight") {
        y = Eigen::Map<const Eigen::Matrix<double, -1, -1, Eigen::RowMajor>>(values, t.out, t.in) * x;
      }
      if (t.name == block + ".0.bias") y += Eigen::Map<const Eigen::VectorXd>(values, t.out);
    }
    return y;
  };
  const auto stack = [](const Eigen::VectorXd& a, double b) {
    Eigen::VectorXd s(a.size() + 1);
    s << a, b;
    return s;
  };
  double recon = 0, state = 0, output = 0;
  int rollouts = 0;
  for (int t = 1; t + 2 <= 12; t += 3, ++rollouts) {  // samples 1 … 12 of the trajectory
    Eigen::VectorXd x = d.states.col(t);
    for (int k = 0; k < 2; ++k) {
      const Eigen::VectorXd latent = affine("encoder", stack(x, d.inputs(0, t + k)));
      if (k == 0) recon += (affine("state_decoder", latent) - x).squaredNorm();
      output += (affine("output_decoder", latent) - d.outputs.col(t + k)).squaredNorm();
      x = affine("state_decoder", affine("transition", stack(latent, d.inputs(0, t + k))));
      state += (x - d.states.col(t + k + 1)).squaredNorm();
    }
  }
  ASSERT_EQ(rollouts, p.shape.rollouts);
  const double expected = 5 * recon / (2 * rollouts) + 3 * state / (4 * rollouts) + 2 * output / (2 * rollouts);
  const LossFunction<double> function(p.model, loss, p.shape, All(p.model), All(p.model));
  auto scratch = function.MakeScratch();
  EXPECT_NEAR(function.Value(p.parameters.data(), p.data, &scratch), expected, 1e-12 * expected);
}

/// A model and a set large enough to be cut into blocks, of rollouts that do not divide evenly.
Problem LargeProblem(const LossSpec& loss) {
  ModelSpec spec{.kind = Case::kStateInputOutput, .input_size = 2, .output_size = 1, .state_size = 3, .latent_size = 8, .window = 1};
  spec.encoder.hidden_widths = {200, 200};
  spec.transition.block.hidden_widths = {30};
  return MakeProblem({"large", spec, loss}, 103);
}

/// [L, ∇L, H v] by any number of threads.
std::vector<double> Everything(const Problem& p, const LossSpec& loss, const LossShape& shape, const LossData<double>& data, size_t threads) {
  const auto executor = base::MakeThreadExecutor(threads);
  const nn::Mask mask = *nn::ParseMask("encoder,transition", p.model.layout());
  const LossFunction<double> function(p.model, loss, shape, mask, All(p.model));
  auto scratch = function.MakeScratch(executor.get());
  const size_t n = p.parameters.size();
  std::vector<double> v(n), all(1 + 2 * n);
  base::Rng rng(5);
  for (double& value : v) value = rng.Normal();
  all[0] = function.Gradient(p.parameters.data(), data, &all[1], &scratch);
  EXPECT_EQ(all[0], function.Value(p.parameters.data(), data, &scratch));
  function.HessianVector(p.parameters.data(), data, v.data(), &all[1 + n], &scratch);
  return all;
}

TEST(LossTest, LargeLossesAreTheSameWhateverTheNumberOfThreads) {
  const LossSpec loss{.horizon = 2, .rollout = RolloutMode::kState, .stride = 1};
  const Problem p = LargeProblem(loss);
  const std::vector<double> serial = Everything(p, loss, p.shape, p.data, 1);
  for (const size_t threads : {2, 3, 8}) EXPECT_EQ(Everything(p, loss, p.shape, p.data, threads), serial) << threads;
}

// A mean over rollouts is the mean of what each has: single rollouts are never cut.
TEST(LossTest, LargeLossesAreTheMeanOfTheirRollouts) {
  const LossSpec loss{.horizon = 2, .rollout = RolloutMode::kState, .stride = 1};
  const Problem p = LargeProblem(loss);
  const std::vector<double> whole = Everything(p, loss, p.shape, p.data, 2);
  const data::Trajectory trajectory = RandomTrajectory(p.model.spec(), 105, 3);  // what MakeProblem cuts from
  std::vector<double> mean(whole.size());
  for (int32_t j = 0; j < p.shape.rollouts; ++j) {
    const LossShape one{1, p.shape.horizon};
    const auto data = CutLossData<double>(p.model.spec(), loss, trajectory, 1 + j, one);
    const std::vector<double> own = Everything(p, loss, one, data, 1);
    for (size_t i = 0; i < mean.size(); ++i) mean[i] += own[i] / p.shape.rollouts;
  }
  for (size_t i = 0; i < mean.size(); ++i) ASSERT_NEAR(whole[i], mean[i], 1e-12 * (1 + Norm(mean))) << i;
}

TEST(LossTest, TooFewSamplesAreRefusedWithTheNumberNeeded) {
  ModelSpec spec{.kind = Case::kInputOutput, .input_size = 1, .output_size = 1, .state_size = 0, .latent_size = 2, .window = 20};
  const absl::StatusOr<LossShape> shape = ShapeOfLoss(spec, {.horizon = 5}, 24);
  EXPECT_EQ(shape.status().code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_NE(std::string(shape.status().message()).find("at least 25 needed"), std::string::npos) << shape.status();
  EXPECT_EQ(ShapeOfLoss(spec, {.horizon = 5}, 25)->rollouts, 1);
}

TEST(LossTest, FloatAgreesWithDouble) {
  const ModelCase c = ModelCases().back();
  const Problem p = MakeProblem(c);
  const LossFunction<double> wide(p.model, c.loss, p.shape, All(p.model), All(p.model));
  const LossFunction<float> narrow(p.model, c.loss, p.shape, All(p.model), All(p.model));
  const std::vector<float> parameters(p.parameters.begin(), p.parameters.end());
  const LossData<float> data = CutLossData<float>(c.model, c.loss, RandomTrajectory(c.model, 11, 3), 1, p.shape);
  auto narrow_scratch = narrow.MakeScratch();
  auto wide_scratch = wide.MakeScratch();
  EXPECT_NEAR(narrow.Value(parameters.data(), data, &narrow_scratch), wide.Value(p.parameters.data(), p.data, &wide_scratch), 1e-5);
}

}  // namespace
}  // namespace metaekf::nssm
