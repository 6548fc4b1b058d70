#pragma once

#include "core/filter/ekf.h"
#include "metaekf/v1/estimation.pb.h"

namespace metaekf::server {

/// How estimates travel.
struct EstimateFormat {
  v1::OpenSession::CovarianceFormat covariance = v1::OpenSession::NONE;
  bool innovations = false;
  bool constrained = false;  ///< with slacks and projections
};

/// Appends an estimate to a batch. @param flags  beyond those that the estimate itself tells.
void WriteEstimate(const EstimateFormat& format, double time_s, const filter::Estimate& estimate, uint32_t flags,
                   v1::EstimateBatch* batch);

}  // namespace metaekf::server
