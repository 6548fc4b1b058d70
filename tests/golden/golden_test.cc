#include <gtest/gtest.h>

#include <fstream>
#include <nlohmann/json.hpp>
#include <sstream>

#include "core/base/json_fields.h"
#include "core/meta/meta_gradient.h"

// Values of PyTorch's automatic differentiation, from an implementation of its own: tests/golden/generate.py.
namespace metaekf {
namespace {

using nlohmann::json;

Eigen::MatrixXd Signal(const json& rows) {
  if (rows.empty()) return {};
  Eigen::MatrixXd signal(rows[0].size(), rows.size());
  for (size_t t = 0; t < rows.size(); ++t) {
    for (size_t i = 0; i < rows[t].size(); ++i) {
      signal(static_cast<Eigen::Index>(i), static_cast<Eigen::Index>(t)) = rows[t][i].get<double>();
    }
  }
  return signal;
}

std::vector<double> Flat(const json& by_name, const nn::ParameterLayout& layout) {
  std::vector<double> values;
  for (const nn::Tensor& tensor : layout.tensors()) {
    const std::vector<double> part = by_name.at(tensor.name).get<std::vector<double>>();
    EXPECT_EQ(static_cast<int64_t>(part.size()), tensor.size()) << tensor.name;
    values.insert(values.end(), part.begin(), part.end());
  }
  return values;
}

void ExpectClose(const std::vector<double>& actual, const std::vector<double>& expected, const std::string& what) {
  ASSERT_EQ(actual.size(), expected.size());
  double norm = 0;
  for (const double value : expected) norm += value * value;
  for (size_t i = 0; i < actual.size(); ++i) {
    EXPECT_NEAR(actual[i], expected[i], 1e-12 * (1 + std::sqrt(norm))) << what << " " << i;
  }
}

TEST(GoldenTest, LossGradientHessianAndMetaGradientMatchPyTorch) {
  std::ifstream file(METAEKF_SOURCE_DIR "/tests/golden/pytorch.json");
  std::stringstream text;
  text << file.rdbuf();
  json golden;
  ASSERT_TRUE(base::ParseJson(text.str(), &golden).ok());
  ASSERT_EQ(golden["cases"].size(), 3u);
  for (const json& c : golden["cases"]) {
    SCOPED_TRACE(c["name"].get<std::string>());
    const nssm::ModelSpec spec = *nssm::ReadModelSpec(base::JsonFields(c["model"], "model"));
    const nssm::LossSpec loss = *nssm::ReadLossSpec(base::JsonFields(c["loss"], "loss"), spec);
    const nssm::Model model = *nssm::Model::Create(spec);
    data::Trajectory trajectory;
    trajectory.inputs = Signal(c["u"]);
    trajectory.outputs = Signal(c["y"]);
    trajectory.states = Signal(c["x"]);
    const nssm::LossShape shape = *nssm::ShapeOfLoss(spec, loss, c["samples"].get<int64_t>());
    const auto context = nssm::CutLossData<double>(spec, loss, trajectory, 0, shape);
    const auto target = nssm::CutLossData<double>(spec, loss, trajectory, c["target_first"].get<int64_t>(), shape);
    const nn::Mask all(model.layout().tensors().size(), true);
    const std::vector<double> parameters = Flat(c["parameters"], model.layout());
    const std::vector<double> direction = Flat(c["direction"], model.layout());
    std::vector<double> result(parameters.size());

    const nssm::LossFunction<double> function(model, loss, shape, all, all);
    auto scratch = function.MakeScratch();
    EXPECT_NEAR(function.Gradient(parameters.data(), context, result.data(), &scratch), c["value"].get<double>(), 1e-12);
    ExpectClose(result, Flat(c["gradient"], model.layout()), "gradient");
    function.HessianVector(parameters.data(), context, direction.data(), result.data(), &scratch);
    ExpectClose(result, Flat(c["hessian_vector"], model.layout()), "Hessian-vector product");

    meta::TrainingSpec training{.loss = loss};
    training.inner_loop = {.steps = c["inner_steps"].get<int32_t>(), .learning_rate = c["inner_lr"].get<double>()};
    const meta::MetaGradient<double> meta_gradient(model, training, shape, shape, all);
    meta::MetaGradient<double>::Scratch meta_scratch(meta_gradient);
    EXPECT_NEAR(meta_gradient.Compute(parameters.data(), context, target, result.data(), &meta_scratch),
                c["target_value"].get<double>(), 1e-12);
    ExpectClose(result, Flat(c["meta_gradient"], model.layout()), "meta-gradient");
  }
}

}  // namespace
}  // namespace metaekf
