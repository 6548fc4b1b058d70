#include "core/nssm/prior.h"

namespace metaekf::nssm {

Eigen::VectorXd AlongLoadings(const GaussianPrior& prior, const Eigen::VectorXd& mean, const Eigen::VectorXd& coordinates) {
  return mean + prior.loadings * coordinates;
}

}  // namespace metaekf::nssm
