#include "server/session/read_options.h"

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "server/status/details.h"

namespace metaekf::server {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

absl::Status ReadNoise(const std::string& field, const v1::NoiseSettings& noise, Index n, Index n_y,
                       filter::FilterOptions* options) {
  const auto read = [&field](const std::string& name, const google::protobuf::RepeatedField<double>& values, Index size,
                       std::optional<MatrixXd>* cov) -> absl::Status {
    if (values.empty()) return absl::OkStatus();
    METAEKF_ASSIGN_OR_RETURN(*cov, ReadCovariance(field + "." + name, values.data(), values.size(), size));
    return absl::OkStatus();
  };
  METAEKF_RETURN_IF_ERROR(read("process_noise_cov", noise.process_noise_cov(), n, &options->process_cov));
  METAEKF_RETURN_IF_ERROR(read("measurement_noise_cov", noise.measurement_noise_cov(), n_y, &options->measurement_cov));
  METAEKF_RETURN_IF_ERROR(read("initial_cov", noise.initial_cov(), n, &options->initial_cov));
  if (!noise.initial_mean().empty()) {
    options->initial_mean = Eigen::Map<const VectorXd>(noise.initial_mean().data(), noise.initial_mean().size());
  }
  return absl::OkStatus();
}

absl::Status ReadGate(const std::string& field, const v1::GateSettings& gate, filter::GateOptions* options) {
  if (gate.off()) {
    options->probability = 0;
    return absl::OkStatus();
  }
  if (gate.probability() != 0) {
    if (!(gate.probability() > 0 && gate.probability() < 1)) {
      return FieldViolation(field + ".probability",
                            absl::StrCat("must be between 0 and 1, got ", base::FormatExact(gate.probability())));
    }
    options->probability = gate.probability();
  }
  if (gate.recover_after() < 0) {
    return FieldViolation(field + ".recover_after", absl::StrCat("must be at least 1, or 0 for the default, got ", gate.recover_after()));
  }
  if (gate.recover_after() > 0) options->recover_after = gate.recover_after();
  return absl::OkStatus();
}

filter::Projection ToProjection(v1::Projection projection) {
  switch (projection) {
    case v1::AUTOENCODER:
      return filter::Projection::kAutoencoder;
    case v1::NO_PROJECTION:
      return filter::Projection::kNone;
    default:
      return filter::Projection::kQuadraticProgram;
  }
}

absl::StatusOr<MatrixXd> ReadCovariance(const std::string& field, const double* values, Index count, Index n) {
  MatrixXd cov = MatrixXd::Zero(n, n);
  if (count != n && count != n * (n + 1) / 2) {
    return FieldViolation(field, absl::StrCat("expected ", n, " values (the diagonal) or ", n * (n + 1) / 2,
                                              " (the lower triangle row by row), got ", count));
  }
  for (Index i = 0, at = 0; i < n; ++i) {
    if (count == n) {
      cov(i, i) = values[i];
      continue;
    }
    for (Index j = 0; j <= i; ++j, ++at) cov(i, j) = cov(j, i) = values[at];
  }
  return cov;
}

}  // namespace metaekf::server
