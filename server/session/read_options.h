#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "core/filter/ekf.h"
#include "metaekf/v1/estimation.pb.h"

namespace metaekf::server {

/// What a client wants of a filter with n states and n_y outputs. Errors: InvalidArgument with violations below `open`.
absl::StatusOr<filter::FilterOptions> ReadFilterOptions(const v1::OpenSession& open, Eigen::Index n, Eigen::Index n_y);

/// The covariance of n quantities from n values, its diagonal, or n(n+1)/2, its lower triangle row by row. For n = 1 both are
/// the same. @param values  `count` of them. Errors: InvalidArgument with a violation of `field` for any other number.
absl::StatusOr<Eigen::MatrixXd> ReadCovariance(const std::string& field, const double* values, Eigen::Index count,
                                               Eigen::Index n);

}  // namespace metaekf::server
