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
