#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "core/base/status.h"
#include "core/filter/ekf.h"
#include "metaekf/v1/estimation.pb.h"

namespace metaekf::server {

absl::Status ReadNoise(const std::string& field, const v1::NoiseSettings& noise, Eigen::Index n, Eigen::Index n_y,
                       filter::FilterOptions* options);
absl::Status ReadGate(const std::string& field, const v1::GateSettings& gate, filter::GateOptions* options);

filter::Projection ToProjection(v1::Projection projection);

/// What a client wants of a filter with n states and n_y outputs. @param request  OpenSession, or another message with those
/// fields. @param field  its name. Errors: InvalidArgument with violations below it.
template <typename Message>
absl::StatusOr<filter::FilterOptions> ReadFilterOptions(const std::string& field, const Message& request, Eigen::Index n,
                                                        Eigen::Index n_y) {
  filter::FilterOptions options{.initial_samples = request.initial_samples(),
                                .projection = ToProjection(request.projection()),
                                .restart_after_divergence = !request.stay_diverged()};
  METAEKF_RETURN_IF_ERROR(ReadNoise(field + ".noise", request.noise(), n, n_y, &options));
  METAEKF_RETURN_IF_ERROR(ReadGate(field + ".gate", request.gate(), &options.gate));
  return options;
}

/// The covariance of n quantities from n values, its diagonal, or n(n+1)/2, its lower triangle row by row. For n = 1 both are
/// the same. @param values  `count` of them. Errors: InvalidArgument with a violation of `field` for any other number.
absl::StatusOr<Eigen::MatrixXd> ReadCovariance(const std::string& field, const double* values, Eigen::Index count,
                                               Eigen::Index n);

}  // namespace metaekf::server
