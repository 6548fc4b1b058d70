#pragma once

#include <Eigen/Core>
#include <string>

#include "core/nssm/bundle.h"

namespace metaekf::support {

/// A bundle whose normalised units are the physical ones: parameters 0, covariances I, channels u1…, y1…, x1….
nssm::Bundle UnitBundle(nssm::Model model);

/// Sets one tensor, given as out × in.
void SetWeight(const std::string& name, const Eigen::MatrixXd& weight, nssm::Bundle* bundle);

}  // namespace metaekf::support
