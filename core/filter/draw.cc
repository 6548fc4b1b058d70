#include "core/filter/draw.h"

#include <Eigen/Cholesky>

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

absl::StatusOr<Future> Draw(const Ekf& ekf, const MatrixXd& inputs, base::Rng* rng, FilterModel::Scratch* scratch) {
  if (!ekf.state_.started || ekf.warming_up()) return absl::FailedPreconditionError("the filter has no estimate yet");
  const auto white = [rng](Index n) {
    VectorXd draw(n);
    for (double& value : draw) value = rng->Normal();
    return draw;
  };
  const data::Normaliser& units = ekf.normaliser_;
  const MatrixXd measurement_factor = Eigen::LLT<MatrixXd>(ekf.measurement_cov_).matrixL();
  const Index n = ekf.state_size_, n_y = ekf.output_size_, n_x = ekf.model_size_;
  VectorXd s = ekf.state_.mean + ekf.state_.factor * white(n), last_input = ekf.state_.last_input, f(n), h(n_y);
  MatrixXd F(n, n), H(n_y, n);
  const auto truth = [&](const VectorXd& input) {
    ekf.joint_.Measurement(s, input, &h, &H, scratch);
    return VectorXd(ekf.case_one_ ? units.outputs.Denormalise(h) : units.states.Denormalise(s.head(n_x)));
  };
  Future future{truth(last_input), MatrixXd(ekf.estimate_size(), inputs.cols()), MatrixXd(n_y, inputs.cols())};
  for (Index t = 0; t < inputs.cols(); ++t) {
    const VectorXd input = units.inputs.Normalise(inputs.col(t));
    ekf.joint_.Transition(s, ekf.next_input_ ? input : last_input, &f, &F, scratch);
    s = f + ekf.process_factor_ * white(n);
    future.truth.col(t) = truth(input);
    future.outputs.col(t) = units.outputs.Denormalise(h + measurement_factor * white(n_y));
    last_input = input;
  }
  return future;
}

}  // namespace metaekf::filter
