// Every meta-learning algorithm on tasks whose answer is known in closed form.
//
// The model is linear and only its output decoder adapts: ŷ = Dψ + d with ψ = E[x; u] + e fixed. With θ = (D, d) and rows
// φ = (ψ, 1) of Φ, the loss of a set of W rollouts is L = |Φθ − y|²/W: gradient A θ − b, Hessian A = 2ΦᵀΦ/W, b = 2Φᵀy/W.
// A and b come from the data here, not from the code under test.

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <cmath>

#include "core/base/numbers.h"
#include "core/meta/adam.h"
#include "core/meta/meta_gradient.h"
#include "tests/core/nssm/random_models.h"

namespace metaekf::meta {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using nssm::LossData;
using nssm::LossShape;
using nssm::LossSpec;
using nssm::ModelSpec;

constexpr int32_t kSamples = 14;

struct Quadratic {
  MatrixXd A;
  VectorXd b;
  VectorXd Gradient(const VectorXd& theta) const { return A * theta - b; }
};

class KnownAnswersTest : public ::testing::Test {
 protected:
  static ModelSpec Linear() {
    ModelSpec spec{.kind = nssm::Case::kStateInputOutput, .input_size = 1, .output_size = 1, .state_size = 2};
    spec.latent_size = 3;
    spec.window = 1;
    spec.precision = nssm::Precision::kFloat64;
    return spec;
  }
  static LossSpec OutputsOnly() {
    return {.horizon = 1, .rollout = nssm::RolloutMode::kState, .state_weight = 0, .reconstruction_weight = 0};
  }

  KnownAnswersTest()
      : model_(*nssm::Model::Create(Linear())),
        shape_(*nssm::ShapeOfLoss(Linear(), OutputsOnly(), kSamples)),
        parameters_(nssm::RandomParameters(model_, 5)),
        mask_(*nn::ParseMask("output_decoder", model_.layout())) {
    const data::Trajectory trajectory = nssm::RandomTrajectory(Linear(), 2 * kSamples, 4);
    Take(trajectory, 0, &context_, &of_context_);
    Take(trajectory, kSamples, &target_, &of_target_);
    const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(of_context_.A);
    EXPECT_GT(eigen.eigenvalues().minCoeff(), 0.01);
    rate_ = 0.5 / eigen.eigenvalues().maxCoeff();
    spec_.loss = OutputsOnly();
    spec_.inner_loop.learning_rate = rate_;
    spec_.inner_loop.steps = 4;
  }

  const nn::Tensor& TensorNamed(const std::string& name) const {
    for (const nn::Tensor& tensor : model_.layout().tensors()) {
      if (tensor.name == name) return tensor;
    }
    ADD_FAILURE() << name;
    return model_.layout().tensors().front();
  }
  MatrixXd Values(const std::string& name, const std::vector<double>& from) const {
    const nn::Tensor& tensor = TensorNamed(name);
    using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
    return Eigen::Map<const RowMajor>(from.data() + tensor.offset, tensor.out, tensor.in);
  }
  VectorXd Theta(const std::vector<double>& from) const {
    VectorXd theta(4);
    theta << Values("output_decoder.0.weight", from).transpose(), Values("output_decoder.0.bias", from);
    return theta;
  }
  void Take(const data::Trajectory& trajectory, Index first, LossData<double>* set, Quadratic* quadratic) const {
    *set = nssm::CutLossData<double>(model_.spec(), OutputsOnly(), trajectory, first, shape_);
    const Index rollouts = shape_.rollouts;
    MatrixXd xu(3, rollouts);
    xu << trajectory.states.middleCols(first, rollouts), trajectory.inputs.middleCols(first, rollouts);
    MatrixXd phi = MatrixXd::Ones(rollouts, 4);
    phi.leftCols(3) = ((Values("encoder.0.weight", parameters_) * xu).colwise() +
                       Values("encoder.0.bias", parameters_).col(0)).transpose();
    const VectorXd y = trajectory.outputs.middleCols(first, rollouts).transpose();
    const double scale = 2 / static_cast<double>(rollouts);
    *quadratic = {scale * phi.transpose() * phi, scale * phi.transpose() * y};
  }

  std::vector<double> Compute(const std::vector<double>& variables) const {
    const MetaGradient<double> meta(model_, spec_, shape_, shape_, mask_);
    MetaGradient<double>::Scratch scratch(meta);
    std::vector<double> gradient(meta.variables());
    meta.Compute(variables.data(), context_, target_, gradient.data(), &scratch);
    return gradient;
  }
  VectorXd MetaGradientOfTheta() const { return Theta(Compute(parameters_)); }

  /// θ after steps of gradient descent on the context set: θ* + (I − βA)^M (θ₀ − θ*).
  VectorXd AfterSteps() const {
    const VectorXd minimum = of_context_.A.ldlt().solve(of_context_.b);
    return minimum + PowerOfStep() * (Theta(parameters_) - minimum);
  }
  MatrixXd PowerOfStep() const {
    const MatrixXd step = MatrixXd::Identity(4, 4) - rate_ * of_context_.A;
    MatrixXd power = MatrixXd::Identity(4, 4);
    for (int32_t m = 0; m < spec_.inner_loop.steps; ++m) power = power * step;
    return power;
  }

  static void ExpectClose(const VectorXd& actual, const VectorXd& expected, double tolerance = 1e-11) {
    EXPECT_LT((actual - expected).norm(), tolerance * expected.norm()) << actual.transpose() << "\n" << expected.transpose();
  }

  const nssm::Model model_;
  const LossShape shape_;
  const std::vector<double> parameters_;
  const nn::Mask mask_;
  LossData<double> context_, target_;
  Quadratic of_context_, of_target_;
  double rate_ = 0;
  TrainingSpec spec_;
};

TEST_F(KnownAnswersTest, MamlIsThePowerOfTheStepTimesTheTargetGradientAtItsEnd) {
  for (const int32_t steps : {0, 1, 5}) {
    spec_.inner_loop.steps = steps;
    ExpectClose(MetaGradientOfTheta(), PowerOfStep() * of_target_.Gradient(AfterSteps()));
  }
}

TEST_F(KnownAnswersTest, FirstOrderMamlIsTheTargetGradientAtTheEndOfTheSteps) {
  spec_.algorithm = Algorithm::kFirstOrderMaml;
  ExpectClose(MetaGradientOfTheta(), of_target_.Gradient(AfterSteps()));
}

TEST_F(KnownAnswersTest, SupervisedIsTheTargetGradientAtTheStart) {
  spec_.algorithm = Algorithm::kSupervised;
  ExpectClose(MetaGradientOfTheta(), of_target_.Gradient(Theta(parameters_)));
}

TEST_F(KnownAnswersTest, ImplicitMamlIsTheInverseOfOnePlusHessianOverLambdaTimesTheTargetGradientAtTheMinimum) {
  for (const double lambda : {0.05, 1.0, 30.0}) {
    spec_.algorithm = Algorithm::kImplicitMaml;
    spec_.inner_loop.proximal = lambda;
    spec_.inner_loop.steps = 5000;
    spec_.implicit_maml = {.cg_steps = 4, .cg_tolerance = 0};  // as many steps as dimensions: exact
    const MatrixXd identity = MatrixXd::Identity(4, 4);
    const VectorXd minimum = (of_context_.A + lambda * identity).ldlt().solve(of_context_.b + lambda * Theta(parameters_));
    ExpectClose(MetaGradientOfTheta(), (identity + of_context_.A / lambda).ldlt().solve(of_target_.Gradient(minimum)), 1e-9);
  }
}

TEST_F(KnownAnswersTest, ImplicitMamlByLevenbergMarquardtIsAtThatMinimumAfterAFewSteps) {
  double worst = 0;
  for (const double lambda : {0.05, 1.0, 30.0}) {
    spec_.algorithm = Algorithm::kImplicitMaml;
    spec_.inner_loop.optimiser = Optimiser::kLevenbergMarquardt;
    spec_.inner_loop.proximal = lambda;
    spec_.inner_loop.steps = 12;
    spec_.implicit_maml = {.cg_steps = 4, .cg_tolerance = 0};
    const MatrixXd identity = MatrixXd::Identity(4, 4);
    const VectorXd minimum = (of_context_.A + lambda * identity).ldlt().solve(of_context_.b + lambda * Theta(parameters_));
    const VectorXd expected = (identity + of_context_.A / lambda).ldlt().solve(of_target_.Gradient(minimum));
    const VectorXd actual = MetaGradientOfTheta();
    ExpectClose(actual, expected, 1e-9);
    worst = std::max(worst, (actual - expected).norm() / expected.norm());
  }
  RecordProperty("worst", base::FormatShort(worst));
}

TEST_F(KnownAnswersTest, ImplicitMamlOfAnInfinitePullIsThePlainGradientInEveryParameter) {
  spec_.algorithm = Algorithm::kSupervised;
  const std::vector<double> plain = Compute(parameters_);
  spec_.algorithm = Algorithm::kImplicitMaml;
  spec_.inner_loop.proximal = 1e12;
  const std::vector<double> implicit = Compute(parameters_);
  for (size_t i = 0; i < plain.size(); ++i) EXPECT_NEAR(implicit[i], plain[i], 1e-10) << i;
}

TEST_F(KnownAnswersTest, ReptileIsTheWayOfTheStepsOnBothSetsOverTheRate) {
  spec_.algorithm = Algorithm::kReptile;
  const Quadratic both{(of_context_.A + of_target_.A) / 2, (of_context_.b + of_target_.b) / 2};
  for (const int32_t steps : {1, 6}) {
    spec_.inner_loop.steps = steps;
    VectorXd theta = Theta(parameters_);
    for (int32_t m = 0; m < steps; ++m) theta -= rate_ * both.Gradient(theta);
    ExpectClose(MetaGradientOfTheta(), (Theta(parameters_) - theta) / rate_);
  }
}

TEST_F(KnownAnswersTest, OneStepOfReptileIsTheMeanOfBothGradientsInEveryParameter) {
  spec_.inner_loop.steps = 1;
  spec_.algorithm = Algorithm::kReptile;
  const std::vector<double> reptile = Compute(parameters_);
  spec_.algorithm = Algorithm::kSupervised;
  const std::vector<double> of_target = Compute(parameters_);
  std::swap(context_, target_);
  const std::vector<double> of_context = Compute(parameters_);
  for (size_t i = 0; i < reptile.size(); ++i) EXPECT_DOUBLE_EQ(reptile[i], (of_context[i] + of_target[i]) / 2) << i;
}

// ∂L(𝓣; θ₀ − β_l g_l)/∂β_l = −⟨∇L(𝓣; θ₁), ∇L(𝓒; θ₀)⟩ over the tensor, times β_l for the logarithm.
TEST_F(KnownAnswersTest, TheGradientOfALearnedRateAfterOneStepIsMinusTheProductOfBothGradients) {
  spec_.inner_loop.steps = 1;
  spec_.inner_loop.learned_rates = true;
  const double of_weight = 0.7 * rate_, of_bias = 1.2 * rate_;
  std::vector<double> variables = parameters_;
  variables.insert(variables.end(), {std::log(of_weight), std::log(of_bias)});
  const VectorXd rates = Eigen::Vector4d(of_weight, of_weight, of_weight, of_bias);
  const VectorXd first = of_context_.Gradient(Theta(parameters_));
  const VectorXd last = of_target_.Gradient(Theta(parameters_) - rates.cwiseProduct(first));
  const double weight = -of_weight * first.head(3).dot(last.head(3)), bias = -of_bias * first[3] * last[3];
  for (const Algorithm algorithm : {Algorithm::kMaml, Algorithm::kFirstOrderMaml}) {
    spec_.algorithm = algorithm;
    const std::vector<double> gradient = Compute(variables);
    ASSERT_EQ(gradient.size(), parameters_.size() + 2);
    EXPECT_NEAR(gradient[parameters_.size()], weight, 1e-12);
    EXPECT_NEAR(gradient[parameters_.size() + 1], bias, 1e-12);
  }
}

// The first step of Adam is β g/(|g| + ε), whose slope in g is β ε/(|g| + ε)².
TEST_F(KnownAnswersTest, OneStepOfAdamIsTheSignOfTheGradient) {
  spec_.inner_loop.optimiser = Optimiser::kAdam;
  spec_.inner_loop.learning_rate = 0.01;
  spec_.inner_loop.steps = 1;
  const Eigen::ArrayXd gradient = of_context_.Gradient(Theta(parameters_)).array();
  const Eigen::ArrayXd size = gradient.abs() + kAdamEpsilon;
  const VectorXd last = of_target_.Gradient(Theta(parameters_) - 0.01 * (gradient / size).matrix());
  const VectorXd slope = 0.01 * kAdamEpsilon / size.square();
  ExpectClose(MetaGradientOfTheta(), last - of_context_.A * slope.cwiseProduct(last));
  spec_.algorithm = Algorithm::kFirstOrderMaml;
  ExpectClose(MetaGradientOfTheta(), last);
  spec_.algorithm = Algorithm::kReptile;
  const Eigen::ArrayXd both = (gradient.matrix() + of_target_.Gradient(Theta(parameters_))).array() / 2;
  ExpectClose(MetaGradientOfTheta(), both / (both.abs() + kAdamEpsilon));
}

TEST_F(KnownAnswersTest, AnInnerLoopWithAnotherTensorsRateEqualsALearnedOneThatStandsThere) {
  spec_.inner_loop.tensor_rates = {{"output_decoder.0.bias", 0.3 * rate_}};
  const std::vector<double> given = Compute(parameters_);
  spec_.inner_loop.learned_rates = true;
  std::vector<double> variables = parameters_;
  variables.insert(variables.end(), {std::log(rate_), std::log(0.3 * rate_)});
  const std::vector<double> learned = Compute(variables);
  for (size_t i = 0; i < given.size(); ++i) EXPECT_NEAR(learned[i], given[i], 1e-13) << i;
}

TEST_F(KnownAnswersTest, AnilWithTheFullMaskIsMamlBitForBit) {
  for (const Optimiser optimiser : {Optimiser::kGradientDescent, Optimiser::kAdam}) {
    spec_.inner_loop.optimiser = optimiser;
    std::vector<std::vector<double>> gradients;
    for (const char* mask : {"*", "encoder,transition*,*_decoder"}) {
      const MetaGradient<double> meta(model_, spec_, shape_, shape_, *nn::ParseMask(mask, model_.layout()));
      MetaGradient<double>::Scratch scratch(meta);
      gradients.emplace_back(parameters_.size());
      meta.Compute(parameters_.data(), context_, target_, gradients.back().data(), &scratch);
    }
    EXPECT_EQ(gradients[0], gradients[1]);
  }
}

TEST_F(KnownAnswersTest, CurvaturesAreTheLargestEigenvaluesOfTheBlocks) {
  const MetaGradient<double> meta(model_, spec_, shape_, shape_, mask_);
  MetaGradient<double>::Scratch scratch(meta);
  const std::vector<double> curvatures = meta.Curvatures(parameters_.data(), context_, &scratch);
  ASSERT_EQ(curvatures.size(), 2u);
  std::vector<std::string> names;
  for (size_t i = 0; i < mask_.size(); ++i) {
    if (mask_[i]) names.push_back(model_.layout().tensors()[i].name);
  }
  const double of_weight = Eigen::SelfAdjointEigenSolver<MatrixXd>(of_context_.A.topLeftCorner(3, 3)).eigenvalues()[2];
  for (size_t l = 0; l < 2; ++l) {
    const double expected = names[l] == "output_decoder.0.weight" ? of_weight : of_context_.A(3, 3);
    EXPECT_LE(curvatures[l], expected * (1 + 1e-12)) << names[l];
    EXPECT_GT(curvatures[l], 0.99 * expected) << names[l];
  }
}

}  // namespace
}  // namespace metaekf::meta
