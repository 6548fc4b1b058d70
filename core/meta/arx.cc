#include "core/meta/arx.h"

#include <algorithm>
#include <limits>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/linalg/decompositions.h"

namespace metaekf::meta {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

VectorXd ArxModel::Regressor(const MatrixXd& inputs, const MatrixXd& outputs, Index t) const {
  const Index n_u = inputs.rows(), n_y = outputs.rows();
  VectorXd row(1 + order_ * n_y + (order_ + 1) * n_u);
  row[0] = 1;
  for (Index i = 1; i <= order_; ++i) row.segment(1 + (i - 1) * n_y, n_y) = outputs.col(t - i);
  for (Index i = 0; i <= order_; ++i) row.segment(1 + order_ * n_y + i * n_u, n_u) = inputs.col(t - i);
  return row;
}

absl::StatusOr<ArxModel> ArxModel::Fit(const data::Trajectory& trajectory, int order) {
  ArxModel model;
  model.order_ = order;
  const Index rows = trajectory.length() - order;
  const Index columns = 1 + order * trajectory.outputs.rows() + (order + 1) * trajectory.inputs.rows();
  if (rows < columns) {
    return absl::FailedPreconditionError(absl::StrCat("ARX(", order, ") needs ", columns + order, " samples, got ",
                                                      trajectory.length()));
  }
  if (!trajectory.outputs.allFinite() || !trajectory.inputs.allFinite()) {
    return absl::InvalidArgumentError("ARX: every input and output must be finite");
  }
  MatrixXd regressors(rows, columns);
  for (Index k = 0; k < rows; ++k) {
    regressors.row(k) = model.Regressor(trajectory.inputs, trajectory.outputs, k + order);
  }
  // Columns of unit length: displacements of 1e-4 m stand beside forces of 100 N.
  VectorXd scale = regressors.colwise().norm();
  scale = (scale.array() > 0).select(scale, 1.0);
  regressors *= scale.cwiseInverse().asDiagonal();
  const MatrixXd targets = trajectory.outputs.rightCols(rows).transpose();
  const MatrixXd solution = linalg::SolveLeastSquares(std::move(regressors), targets);
  model.coefficients_ = (scale.cwiseInverse().asDiagonal() * solution).transpose();
  return model;
}

MatrixXd ArxModel::Predict(const data::Trajectory& trajectory, bool simulate, Index warmup) const {
  const Index start = std::max<Index>(order_, warmup);
  MatrixXd prediction = MatrixXd::Constant(trajectory.outputs.rows(), trajectory.length(),
                                           std::numeric_limits<double>::quiet_NaN());
  MatrixXd outputs = trajectory.outputs;
  for (Index t = start; t < trajectory.length(); ++t) {
    prediction.col(t) = coefficients_ * Regressor(trajectory.inputs, outputs, t);
    if (simulate) outputs.col(t) = prediction.col(t);
  }
  return prediction;
}

}  // namespace metaekf::meta
