#include "core/filter/filter_model.h"

#include <gtest/gtest.h>

#include "tests/core/filter/linear_filter.h"
#include "tests/core/nssm/random_models.h"

namespace metaekf::filter {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

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

// In two dimensions and three, for every smooth activation, at all sizes of weights and states: ∂h_i/∂p_j = ∂h_j/∂p_i, in the EKF's exact H
// and in central differences of h.
TEST(FilterModelTest, ACurlFreeFieldHasASymmetricJacobianEverywhere) {
  using autodiff::Activation;
  double worst = 0;
  for (const Activation activation : {Activation::kSwish, Activation::kTanh, Activation::kMish, Activation::kSoftplus}) {
    for (const std::vector<int32_t>& positions : {std::vector<int32_t>{0, 2}, {3, 0, 1}}) {
      const nn::BlockSpec block{.hidden_widths = {8, 6}, .activation = activation};
      nssm::ModelSpec spec{.kind = nssm::Case::kStateInputOutput, .input_size = 1, .output_size = static_cast<int32_t>(positions.size()),
                           .state_size = 4, .latent_size = 5, .window = 1};
      spec.encoder = spec.output_decoder = block;
      spec.curl_free_positions = positions;
      spec.precision = nssm::Precision::kFloat64;
      const nssm::Model model = *nssm::Model::Create(spec);
      const auto filter_model = FilterModel::Create(nssm::Bundle{.model = model});
      const auto scratch = filter_model->MakeScratch();
      base::Rng rng(3);
      const Eigen::Index d = spec.output_size;
      VectorXd h(d), moved(d);
      MatrixXd H(d, 4), unused(d, 4);
      for (int trial = 0; trial < 200; ++trial) {
        std::vector<double> parameters = nssm::RandomParameters(model, static_cast<uint64_t>(trial));
        const double size = std::pow(10.0, rng.Uniform(-1, 0.5));
        for (double& value : parameters) value *= size;
        const auto prepared = filter_model->Prepare(parameters);
        const VectorXd x = std::pow(10.0, rng.Uniform(-2, 1)) * RandomVector(&rng, 4), u = RandomVector(&rng, 1);
        filter_model->Measurement(*prepared, x, u, &h, &H, scratch.get());
        const MatrixXd J = H(Eigen::all, positions);
        if (J.norm() == 0) continue;
        worst = std::max(worst, (J - J.transpose()).norm() / J.norm());
        MatrixXd differences(d, d);
        constexpr double kStep = 1e-4;
        for (Eigen::Index j = 0; j < d; ++j) {  // of fourth order: fields may be steep
          const auto at = [&](double shift) -> const VectorXd& {
            filter_model->Measurement(*prepared, x + shift * VectorXd::Unit(4, positions[static_cast<size_t>(j)]), u, &moved, &unused, scratch.get());
            return moved;
          };
          differences.col(j) = 8 * at(kStep);
          differences.col(j) -= 8 * at(-kStep);
          differences.col(j) -= at(2 * kStep);
          differences.col(j) += at(-2 * kStep);
          differences.col(j) /= 12 * kStep;
        }
        EXPECT_LT((differences - J).norm(), 1e-6 * (J.norm() + h.norm()) + 1e-9) << trial;  // what rounding leaves of a difference
      }
    }
  }
  EXPECT_LT(worst, 1e-12);
}

}  // namespace
}  // namespace metaekf::filter
