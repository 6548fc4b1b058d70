#include "core/filter/unknown_directions.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kFleetShare = 1e-6;  // of the fleet's widest direction, from where on systems differ

/// Orthonormal directions in which the fits of a fleet differ, of p parameters; all where they are not known.
MatrixXd FleetDirections(const nssm::Bundle& bundle, Index p) {
  if (!bundle.prior || bundle.prior->examples.cols() < 2 || bundle.prior->examples.rows() != p) return MatrixXd::Identity(p, p);
  const MatrixXd deviations = bundle.prior->examples.colwise() - bundle.prior->examples.rowwise().mean();
  const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(MatrixXd(deviations * deviations.transpose()));
  const VectorXd& sizes = eigen.eigenvalues();
  const Index kept = (sizes.array() > kFleetShare * sizes.maxCoeff()).count();
  return eigen.eigenvectors().rightCols(kept);
}

}  // namespace

MatrixXd UnknownDirections(const nssm::Bundle& bundle) {
  const Index size = bundle.model.layout().size();
  if (!bundle.posterior) return MatrixXd(size, 0);
  const nssm::GaussianPosterior& posterior = *bundle.posterior;
  const Eigen::LLT<MatrixXd> information(posterior.information);
  if (information.info() != Eigen::Success || posterior.information.rows() == 0) return MatrixXd(size, 0);
  const bool few = posterior.coordinates.size() > 0;
  const MatrixXd among = few ? MatrixXd(MatrixXd::Identity(posterior.information.rows(), posterior.information.rows()))
                             : FleetDirections(bundle, posterior.information.rows());
  const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(MatrixXd(among.transpose() * information.solve(among)));
  const Index r = std::min(kMostDirections, among.cols());
  MatrixXd widest = among * eigen.eigenvectors().rightCols(r) * eigen.eigenvalues().tail(r).cwiseMax(0).cwiseSqrt().asDiagonal();
  if (few) widest = bundle.prior->loadings * widest;
  MatrixXd directions = MatrixXd::Zero(size, r);
  Index row = 0;
  for (size_t i = 0; i < posterior.mask.size(); ++i) {
    const nn::Tensor& tensor = bundle.model.layout().tensors()[i];
    if (!posterior.mask[i]) continue;
    directions.middleRows(tensor.offset, tensor.size()) = widest.middleRows(row, tensor.size());
    row += tensor.size();
  }
  return directions;
}

}  // namespace metaekf::filter
