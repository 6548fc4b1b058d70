#include "core/meta/proximal_fit.h"

namespace metaekf::meta {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

VectorXd VarianceOfLoss(const nssm::RolloutLeastSquares& problem, const nssm::LossSpec& loss,
                        const nssm::LossData<double>& data) {
  const Index samples = Index{data.shape.rollouts} * data.shape.horizon;
  const Index values = static_cast<Index>(data.outputs.size()), outputs = values / samples;
  const Index states = problem.channels() - outputs;
  VectorXd variance(states + outputs);
  variance.head(states).setConstant(static_cast<double>(states * samples) / (2 * loss.state_weight));
  variance.tail(outputs).setConstant(static_cast<double>(values) / (2 * loss.output_weight));
  return variance;
}

MapFit FitProximal(const nssm::RolloutLeastSquares& problem, const nssm::LossSpec& loss, const nssm::LossData<double>& data,
                   const std::vector<double>& start, const ProximalFitOptions& options,
                   nssm::RolloutLeastSquares::Workspace* workspace, const OnIteration& on_iteration) {
  const Index p = problem.adapted_size();
  const Belief belief{.mean = GatherAdapted(problem, start),
                      .precision = options.proximal * MatrixXd::Identity(p, p),
                      .noise_variance = VarianceOfLoss(problem, loss, data)};
  const MapFitOptions fit_options{.optimiser = {.max_iterations = options.steps, .tolerance = options.tolerance}};
  return FitMap(problem, data, start, belief, belief.mean, fit_options, workspace, on_iteration);
}

}  // namespace metaekf::meta
