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

/// What an estimate's row of a batch takes, in bytes. @param states, outputs  as many as the filter has.
int64_t RowBytes(const EstimateFormat& format, int64_t states, int64_t outputs);

/// Makes room in a batch for so many estimates and no more.
void Reserve(const EstimateFormat& format, int64_t states, int64_t outputs, int64_t rows, v1::EstimateBatch* batch);

/// Appends an estimate to a batch. @param flags  beyond those that the estimate itself tells.
void WriteEstimate(const EstimateFormat& format, double time_s, const filter::Estimate& estimate, uint32_t flags,
                   v1::EstimateBatch* batch);

}  // namespace metaekf::server
