#include "tests/support/bundles.h"

#include <gtest/gtest.h>

#include <utility>
#include <vector>

namespace metaekf::support {

nssm::Bundle UnitBundle(nssm::Model model) {
  const nssm::ModelSpec spec = model.spec();
  const auto unit = [](int32_t n) { return data::ChannelScaling{Eigen::VectorXd::Zero(n), Eigen::VectorXd::Ones(n)}; };
  const auto names = [](const std::string& letter, int32_t n) {
    std::vector<std::string> result;
    for (int32_t i = 1; i <= n; ++i) result.push_back(letter + std::to_string(i));
    return result;
  };
  const int32_t n = spec.is_case_one() ? spec.latent_size : spec.state_size;
  nssm::Bundle bundle{.model = std::move(model)};
  bundle.parameters.assign(static_cast<size_t>(bundle.model.layout().size()), 0.0);
  bundle.normaliser = {unit(spec.input_size), unit(spec.output_size), unit(spec.state_size)};
  bundle.sample_period_s = 0.1;
  bundle.names = {names("u", spec.input_size), names("y", spec.output_size), names("x", spec.state_size)};
  bundle.noise = {Eigen::MatrixXd::Identity(n, n), Eigen::MatrixXd::Identity(spec.output_size, spec.output_size),
                  Eigen::MatrixXd::Identity(n, n)};
  return bundle;
}

void SetWeight(const std::string& name, const Eigen::MatrixXd& weight, nssm::Bundle* bundle) {
  for (const nn::Tensor& tensor : bundle->model.layout().tensors()) {
    if (tensor.name != name) continue;
    ASSERT_EQ(weight.rows(), tensor.out);
    ASSERT_EQ(weight.cols(), tensor.in);
    Eigen::Map<Eigen::Matrix<double, -1, -1, Eigen::RowMajor>>(bundle->parameters.data() + tensor.offset, tensor.out,
                                                               tensor.in) = weight;
    return;
  }
  FAIL() << "no tensor " << name;
}

}  // namespace metaekf::support
