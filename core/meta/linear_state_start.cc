#include "core/meta/linear_state_start.h"

#include <cmath>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/linalg/decompositions.h"
#include "core/nn/parameters.h"

namespace metaekf::meta {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double kFloor = 1e-2;        // ε, of variances of normalised states
constexpr double kRidge = 1e-4;        // ρ
constexpr double kNetworkScale = 0.01;

/// v of every sample but the last: what the encoder sees.
MatrixXd Features(const nssm::ModelSpec& spec, const data::Trajectory& normalised) {
  const nssm::AngleSpec& angles = spec.angles;
  const Index n = spec.state_size, a = static_cast<Index>(angles.states.size()), count = normalised.length() - 1;
  MatrixXd v(n + 2 * a + spec.input_size, count);
  v.topRows(n) = normalised.states.leftCols(count);
  for (Index k = 0; k < a; ++k) {
    const int32_t state = angles.states[static_cast<size_t>(k)];
    const bool has_units = angles.scale.size() > 0;
    const auto angle = v.row(state).array() * (has_units ? angles.scale[state] : 1) + (has_units ? angles.mean[state] : 0);
    v.row(n + 2 * k) = angle.sin();
    v.row(n + 2 * k + 1) = angle.cos();
  }
  v.bottomRows(spec.input_size) = normalised.inputs.leftCols(count);
  return v;
}

Index FeatureCount(const nssm::ModelSpec& spec) { return spec.state_size + 2 * static_cast<Index>(spec.angles.states.size()) + spec.input_size; }

}  // namespace

absl::Status CheckLinearStateStart(const nssm::ModelSpec& spec) {
  if (spec.is_case_one()) return absl::InvalidArgumentError("a linear start needs states: a model of Case II (STATE_INPUT_OUTPUT)");
  if (spec.transition.bypass != nssm::Bypass::kLinear) return absl::InvalidArgumentError("a linear start needs model.transition.bypass LINEAR");
  if (!spec.encoder.hidden_widths.empty() || !spec.state_decoder.hidden_widths.empty()) {
    return absl::InvalidArgumentError("a linear start needs an encoder and a state_decoder without hidden layers");
  }
  const bool known = spec.state_size != nssm::ModelSpec::kFromData && spec.input_size != nssm::ModelSpec::kFromData;
  if (known && spec.latent_size < FeatureCount(spec)) {
    return absl::InvalidArgumentError(absl::StrCat("a linear start needs at least ", FeatureCount(spec),
                                                   " latents, one for each state, sine, cosine and input; latent_size is ", spec.latent_size));
  }
  return absl::OkStatus();
}

absl::StatusOr<std::vector<double>> LinearStateStart(const nssm::Model& model, const std::vector<data::Trajectory>& fleet, uint64_t seed) {
  const nssm::ModelSpec& spec = model.spec();
  METAEKF_RETURN_IF_ERROR(CheckLinearStateStart(spec));
  const Index n = spec.state_size, features = FeatureCount(spec);
  MatrixXd moments = MatrixXd::Zero(features, features), next = MatrixXd::Zero(features, n), outputs = MatrixXd::Zero(features, spec.output_size);
  double count = 0;
  for (const data::Trajectory& trajectory : fleet) {
    const MatrixXd v = Features(spec, trajectory);
    moments += v * v.transpose();
    next += v * trajectory.states.rightCols(v.cols()).transpose();
    outputs += v * trajectory.outputs.leftCols(v.cols()).transpose();
    count += static_cast<double>(v.cols());
  }
  const linalg::SymmetricEigen eigen = linalg::DecomposeSymmetric(moments / count);
  const VectorXd root = (eigen.values.cwiseMax(0.0).array() + kFloor).sqrt();
  const MatrixXd encoder = root.cwiseInverse().asDiagonal() * eigen.vectors.transpose(), decoder = eigen.vectors * root.asDiagonal();
  moments.diagonal().array() += kRidge * count;
  MatrixXd transition = MatrixXd::Identity(features, features);
  transition.topRows(n) = linalg::SolveLeastSquares(moments, next).transpose();
  const MatrixXd output = linalg::SolveLeastSquares(moments, outputs).transpose();

  std::vector<double> parameters = model.InitialParameters(seed);
  const auto tensor = [&](const std::string& name) { return nn::TensorIn(model.layout(), name, parameters); };
  tensor("encoder.0.weight").topRows(features) = encoder;
  tensor("state_decoder.0.weight").leftCols(features) = decoder.topRows(n);
  tensor("state_decoder.0.weight").rightCols(spec.latent_size - features).setZero();
  tensor("transition.state_bypass.weight").topLeftCorner(features, features) = encoder * transition * decoder;
  if (spec.transition.form != nssm::TransitionForm::kAutonomous && spec.input_size > 0) tensor("transition.input_bypass.weight").setZero();
  tensor(absl::StrCat("transition.", spec.transition.block.hidden_widths.size(), ".weight")) *= kNetworkScale;
  if (spec.output_decoder.hidden_widths.empty() && !spec.is_curl_free()) {
    tensor("output_decoder.0.weight").leftCols(features) = output * decoder;
    tensor("output_decoder.0.weight").rightCols(spec.latent_size - features).setZero();
  }
  return parameters;
}

}  // namespace metaekf::meta
