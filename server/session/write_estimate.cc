#include "server/session/write_estimate.h"

namespace metaekf::server {

using Eigen::Index;
using v1::EstimateBatch;

namespace {

EstimateBatch::Health ToMessage(filter::Health health) {
  switch (health) {
    case filter::Health::kWarmingUp:
      return EstimateBatch::WARMING_UP;
    case filter::Health::kConsistent:
      return EstimateBatch::CONSISTENT;
    case filter::Health::kOverconfident:
      return EstimateBatch::OVERCONFIDENT;
    case filter::Health::kUnderconfident:
      return EstimateBatch::UNDERCONFIDENT;
    case filter::Health::kDiverged:
      return EstimateBatch::DIVERGED;
  }
  return EstimateBatch::HEALTH_UNSPECIFIED;
}

void AddLowerTriangle(const Eigen::MatrixXd& matrix, google::protobuf::RepeatedField<double>* values) {
  for (Index i = 0; i < matrix.rows(); ++i) {
    for (Index j = 0; j <= i; ++j) values->Add(matrix(i, j));
  }
}

}  // namespace

int64_t RowBytes(const EstimateFormat& format, int64_t states, int64_t outputs) {
  int64_t values = 2 + states;  // time and NIS
  if (format.covariance == v1::OpenSession::DIAGONAL) values += states;
  if (format.covariance == v1::OpenSession::LOWER_TRIANGLE) values += states * (states + 1) / 2;
  if (format.innovations) values += outputs + outputs * (outputs + 1) / 2;
  if (format.constrained) values += 2;
  return 8 * values + 8;  // and health and flags
}

void Reserve(const EstimateFormat& format, int64_t states, int64_t outputs, int64_t rows, EstimateBatch* batch) {
  const auto reserve = [rows](auto* values, int64_t per_row) { values->Reserve(static_cast<int>(rows * per_row)); };
  reserve(batch->mutable_times_s(), 1);
  reserve(batch->mutable_means(), states);
  if (format.covariance == v1::OpenSession::DIAGONAL) reserve(batch->mutable_covariances(), states);
  if (format.covariance == v1::OpenSession::LOWER_TRIANGLE) reserve(batch->mutable_covariances(), states * (states + 1) / 2);
  if (format.innovations) {
    reserve(batch->mutable_innovations(), outputs);
    reserve(batch->mutable_innovation_covs(), outputs * (outputs + 1) / 2);
  }
  reserve(batch->mutable_nis(), 1);
  reserve(batch->mutable_health(), 1);
  reserve(batch->mutable_flags(), 1);
  if (format.constrained) {
    reserve(batch->mutable_slacks(), 1);
    reserve(batch->mutable_projections(), 1);
  }
}

void WriteEstimate(const EstimateFormat& format, double time_s, const filter::Estimate& estimate, uint32_t flags,
                   EstimateBatch* batch) {
  batch->add_times_s(time_s);
  batch->mutable_means()->Add(estimate.mean.begin(), estimate.mean.end());
  if (format.covariance == v1::OpenSession::DIAGONAL) {
    for (Index i = 0; i < estimate.cov.rows(); ++i) batch->add_covariances(estimate.cov(i, i));
  } else if (format.covariance == v1::OpenSession::LOWER_TRIANGLE) {
    AddLowerTriangle(estimate.cov, batch->mutable_covariances());
  }
  if (format.innovations) {
    batch->mutable_innovations()->Add(estimate.innovation.begin(), estimate.innovation.end());
    AddLowerTriangle(estimate.innovation_cov, batch->mutable_innovation_covs());
  }
  batch->add_nis(estimate.nis);
  batch->add_health(ToMessage(estimate.health));
  if (estimate.gated > 0) flags |= EstimateBatch::GATED;
  if (estimate.reset) flags |= EstimateBatch::RESET;
  if (format.constrained) {
    if (estimate.projection > 0) flags |= EstimateBatch::PROJECTED;
    batch->add_slacks(estimate.slack);
    batch->add_projections(estimate.projection);
  }
  batch->add_flags(flags);
}

}  // namespace metaekf::server
