#include "core/meta/linear_start.h"

#include <algorithm>
#include <cmath>

#include "absl/strings/str_cat.h"
#include "core/base/rng.h"
#include "core/linalg/decompositions.h"
#include "core/nn/parameters.h"

namespace metaekf::meta {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr Index kLongestOrder = 20;
// Of the mean square of a regressor. Without it an input that leaves frequencies out lets the ARX model invent modes there.
constexpr double kArxRidge = 1e-4;
constexpr Index kResponse = 400;   // samples of the impulse response
constexpr double kLargestPole = 0.999;
constexpr double kLatentStd = 0.3;     // small: the hidden units begin where they are nearly linear
constexpr double kSlowOutput = 0.3;    // standard deviation of what the output sees of a slow mode

/// h_0 … h_{count−1}, n_y × n_u each, of the ARX model of the given order.
std::vector<MatrixXd> ImpulseResponse(const data::Trajectory& recording, Index order, Index count) {
  const MatrixXd &u = recording.inputs, &y = recording.outputs;
  const Index n_u = u.rows(), n_y = y.rows(), regressors = order * n_y + (order + 1) * n_u;
  const Index rows = y.cols() - order;
  MatrixXd phi(regressors, rows);
  for (Index t = 0; t < rows; ++t) {
    for (Index i = 1; i <= order; ++i) phi.block((i - 1) * n_y, t, n_y, 1) = y.col(t + order - i);
    for (Index i = 0; i <= order; ++i) phi.block(order * n_y + i * n_u, t, n_u, 1) = u.col(t + order - i);
  }
  MatrixXd gram = phi * phi.transpose();
  gram.diagonal().array() += kArxRidge * gram.diagonal().mean();
  const MatrixXd theta = linalg::SolveLeastSquares(gram, phi * y.rightCols(rows).transpose()).transpose();
  std::vector<MatrixXd> response;
  for (Index k = 0; k < count; ++k) {
    MatrixXd h = k <= order ? MatrixXd(theta.middleCols(order * n_y + k * n_u, n_u)) : MatrixXd::Zero(n_y, n_u);
    for (Index i = 1; i <= std::min(order, k); ++i) {
      h += theta.middleCols((i - 1) * n_y, n_y) * response[static_cast<size_t>(k - i)];
    }
    response.push_back(h);
  }
  return response;
}

}  // namespace

absl::StatusOr<std::vector<double>> LinearStart(const nssm::Model& model, const data::Trajectory& normalised, uint64_t seed) {
  const nssm::ModelSpec& spec = model.spec();
  if (!spec.is_case_one() || spec.transition.bypass != nssm::Bypass::kLinear || !spec.output_decoder.hidden_widths.empty()) {
    return absl::InvalidArgumentError("a linear start needs a Case I model with a linear bypass and a linear output decoder");
  }
  const Index n_u = spec.input_size, n_y = spec.output_size;
  const Index slow = std::max<Index>(0, spec.latent_size - 2 * n_y), n = spec.latent_size - slow;
  const Index order = std::min<Index>(kLongestOrder, (normalised.length() - 1) / (3 * (n_u + n_y)));
  if (order < n) {
    return absl::FailedPreconditionError(absl::StrCat("a linear start of order ", n, " needs at least ",
                                                      3 * (n_u + n_y) * n + 1, " samples, there are ", normalised.length()));
  }
  const std::vector<MatrixXd> h = ImpulseResponse(normalised, order, kResponse);
  // With the next input ψ_t = L ψ_{t−1} + B u_t, so h_k = C Lᵏ B; else h_k = C Lᵏ⁻¹ B.
  const Index first = spec.transition.input_time == nssm::InputTime::kNext ? 0 : 1;
  const Index half = (kResponse - first - 1) / 2;
  MatrixXd hankel(half * n_y, half * n_u);
  for (Index i = 0; i < half; ++i) {
    for (Index j = 0; j < half; ++j) hankel.block(i * n_y, j * n_u, n_y, n_u) = h[static_cast<size_t>(first + i + j)];
  }
  if (!hankel.allFinite()) return absl::FailedPreconditionError("the ARX model behind the linear start is unstable");
  const linalg::SingularValues svd = linalg::DecomposeSingularValues(hankel);
  const VectorXd root = svd.values.head(n).cwiseMax(1e-9 * svd.values[0]).cwiseSqrt();
  const MatrixXd observability = svd.u.leftCols(n) * root.asDiagonal();
  const MatrixXd controllability = root.asDiagonal() * svd.v.leftCols(n).transpose();
  const MatrixXd upper = observability.topRows((half - 1) * n_y), lower = observability.bottomRows((half - 1) * n_y);
  MatrixXd transition = linalg::SolveLeastSquares(upper, lower);
  MatrixXd output = observability.topRows(n_y), input = controllability.leftCols(n_u);
  const double radius = linalg::Eigenvalues(transition).cwiseAbs().maxCoeff();
  if (radius > kLargestPole) transition *= kLargestPole / radius;
  // Slow modes, leaky integrators of the input: what the network will bend into memory.
  base::Rng rng(seed, 1);
  const Index all = spec.latent_size;
  transition.conservativeResizeLike(MatrixXd::Zero(all, all));
  input.conservativeResizeLike(MatrixXd::Zero(all, n_u));
  output.conservativeResizeLike(MatrixXd::Zero(n_y, all));
  for (Index i = 0; i < slow; ++i) {
    transition(n + i, n + i) = 1 - 0.1 * std::pow(0.3, static_cast<double>(i));
    for (Index j = 0; j < n_u; ++j) input(n + i, j) = rng.Normal();
  }
  // The same standard deviation of every latent on the recording.
  VectorXd latent = VectorXd::Zero(all), squares = VectorXd::Zero(all);
  for (Index t = 0; t < normalised.length(); ++t) {
    latent = transition * latent + input * normalised.inputs.col(t);
    squares += latent.cwiseAbs2();
  }
  const VectorXd scale = (squares / static_cast<double>(normalised.length())).cwiseSqrt().cwiseMax(1e-9) / kLatentStd;
  transition = scale.cwiseInverse().asDiagonal() * transition * scale.asDiagonal();
  input = scale.cwiseInverse().asDiagonal() * input;
  output = output * scale.asDiagonal();
  for (Index i = n; i < all; ++i) {
    for (Index j = 0; j < n_y; ++j) output(j, i) = kSlowOutput * rng.Normal();
  }

  std::vector<double> parameters = model.InitialParameters(seed);
  const auto tensor = [&](const std::string& name) { return nn::TensorIn(model.layout(), name, parameters); };
  if (tensor("transition.input_bypass.weight").size() == 0) return absl::InvalidArgumentError("a linear start needs inputs beside the linear bypass");
  tensor("transition.state_bypass.weight") = transition;
  tensor("transition.input_bypass.weight") = input;
  tensor("output_decoder.0.weight") = output;
  return parameters;
}

}  // namespace metaekf::meta
