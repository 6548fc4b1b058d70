#include "tests/core/filter/linear_filter.h"

#include <Eigen/Cholesky>
#include <cmath>

#include "tests/support/bundles.h"

namespace metaekf::filter {
namespace {

Eigen::MatrixXd Root(const Eigen::MatrixXd& cov) { return cov.llt().matrixL(); }

}  // namespace

Eigen::VectorXd RandomVector(base::Rng* rng, Eigen::Index n) {
  Eigen::VectorXd v(n);
  for (double& value : v) value = rng->Normal();
  return v;
}

nssm::Bundle LinearBundle(const LinearSystem& system) {
  nssm::ModelSpec spec{.kind = nssm::Case::kStateInputOutput, .input_size = 1, .output_size = 2, .state_size = 2, .latent_size = 3, .window = 1};
  spec.precision = nssm::Precision::kFloat64;
  nssm::Bundle bundle = support::UnitBundle(*nssm::Model::Create(spec));
  bundle.noise = {system.Q, system.R, system.P0};
  // ψ = [x; u]; 𝓐 advances it and drops u; 𝓓x and 𝓓y read x.
  support::SetWeight("encoder.0.weight", Eigen::MatrixXd::Identity(3, 3), &bundle);
  Eigen::MatrixXd transition = Eigen::MatrixXd::Zero(3, 4);
  transition.topLeftCorner(2, 2) = system.A;
  transition.block(0, 2, 2, 1) = 0.5 * system.B;  // u enters twice: through ψ and beside it
  transition.block(0, 3, 2, 1) = 0.5 * system.B;
  support::SetWeight("transition.0.weight", transition, &bundle);
  support::SetWeight("state_decoder.0.weight", Eigen::MatrixXd::Identity(2, 3), &bundle);
  Eigen::MatrixXd output = Eigen::MatrixXd::Zero(2, 3);
  output.leftCols(2) = system.C;
  support::SetWeight("output_decoder.0.weight", output, &bundle);
  return bundle;
}

Filter::Filter(const nssm::Bundle& bundle, const FilterOptions& options)
    : model(FilterModel::Create(bundle)),
      scratch(model->MakeScratch()),
      ekf(*Ekf::Create(bundle, model, model->Prepare(bundle.parameters), options)),
      estimate(ekf.MakeEstimate()) {}

LinearTruth::LinearTruth(const LinearSystem& linear, uint64_t seed) : system(linear), rng(seed) {
  state = Root(system.P0) * RandomVector(&rng, 2);
}

void LinearTruth::Advance(double u) { state = system.A * state + system.B * u + Root(system.Q) * RandomVector(&rng, 2); }

Eigen::VectorXd LinearTruth::Measure() { return system.C * state + Root(system.R) * RandomVector(&rng, 2); }

nssm::Bundle ErringSystem::Known() const {
  nssm::Bundle bundle = LinearBundle(system);
  bundle.noise.process_bias = of_f;
  bundle.noise.measurement_bias = of_h;
  return bundle;
}

data::Trajectory ErringSystem::Record(uint64_t seed, Eigen::Index steps) const {
  LinearTruth truth(system, seed);
  Eigen::VectorXd c_f = RandomVector(&truth.rng, 1), c_h = RandomVector(&truth.rng, 2);
  const auto next = [&](const Eigen::VectorXd& c, double correlation) {
    return Eigen::VectorXd(correlation * c + std::sqrt(1 - correlation * correlation) * RandomVector(&truth.rng, c.size()));
  };
  data::Trajectory trajectory{.inputs = Eigen::MatrixXd(1, steps), .outputs = Eigen::MatrixXd(2, steps), .states = Eigen::MatrixXd(2, steps)};
  for (Eigen::Index t = 0; t < steps; ++t) {
    trajectory.states.col(t) = truth.state;
    trajectory.outputs.col(t) = truth.Measure() + of_h.loadings * c_h;
    trajectory.inputs(0, t) = truth.rng.Normal();
    truth.Advance(trajectory.inputs(0, t));
    truth.state += of_f.loadings * c_f;
    c_f = next(c_f, of_f.correlation);
    c_h = next(c_h, of_h.correlation);
  }
  return trajectory;
}

}  // namespace metaekf::filter
