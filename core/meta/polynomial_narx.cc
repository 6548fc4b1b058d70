#include "core/meta/polynomial_narx.h"

#include <algorithm>
#include <limits>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/linalg/decompositions.h"

namespace metaekf::meta {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kRidge = 1e-12;    // of the standardised monomials' mean square: what rounding leaves
constexpr double kDiverged = 1e3;   // standard deviations of the data

/// Products that build every monomial of degree 1 … `degree` of `size` variables from one of a degree less, without
/// repetition: the variable multiplied with is never before those that are in it already.
std::vector<std::pair<Index, Index>> Products(Index size, int degree) {
  std::vector<std::pair<Index, Index>> products;
  std::vector<std::pair<Index, Index>> last = {{0, 0}};  // monomials of the degree before: index, first variable allowed
  for (int d = 1; d <= degree; ++d) {
    std::vector<std::pair<Index, Index>> next;
    for (const auto& [monomial, first] : last) {
      for (Index variable = first; variable < size; ++variable) {
        products.emplace_back(monomial, variable);
        next.emplace_back(static_cast<Index>(products.size()), variable);
      }
    }
    last = std::move(next);
  }
  return products;
}

/// Monomials of degree 0 … d in m variables: (m + d)! / (m! d!).
double CountMonomials(Index variables, int degree) {
  double count = 1;
  for (int i = 1; i <= degree; ++i) count *= static_cast<double>(variables + i) / i;
  return count;
}

absl::Status Check(const data::Trajectory& trajectory, int order, int degree) {
  if (order < 1 || degree < 1) {
    return absl::InvalidArgumentError(absl::StrCat("NARX: order ", order, " and degree ", degree, " must be positive"));
  }
  const Index variables = order * trajectory.outputs.rows() + (order + 1) * trajectory.inputs.rows();
  const double terms = CountMonomials(variables, degree);
  if (terms > PolynomialNarxModel::kMostTerms + 0.5) {
    return absl::InvalidArgumentError(absl::StrCat("NARX(", order, ") of degree ", degree, " has ", terms,
                                                   " terms, more than ", PolynomialNarxModel::kMostTerms));
  }
  if (static_cast<double>(trajectory.length() - order) < terms - 0.5) {
    return absl::FailedPreconditionError(absl::StrCat("NARX(", order, ") of degree ", degree, " needs ", terms + order,
                                                      " samples, got ", trajectory.length()));
  }
  if (!trajectory.outputs.allFinite() || !trajectory.inputs.allFinite()) {
    return absl::InvalidArgumentError("NARX: every input and output must be finite");
  }
  return absl::OkStatus();
}

/// The deviation of columns about their means; one where there is none.
VectorXd Deviation(const MatrixXd& rows, const VectorXd& mean) {
  VectorXd scale = ((rows.rowwise() - mean.transpose()).colwise().squaredNorm() / static_cast<double>(rows.rows())).cwiseSqrt();
  return (scale.array() > 0).select(scale, 1.0);
}

}  // namespace

VectorXd PolynomialNarxModel::Regressor(const MatrixXd& inputs, const MatrixXd& outputs, Index t) const {
  const Index n_u = inputs.rows(), n_y = outputs.rows();
  VectorXd v(order_ * n_y + (order_ + 1) * n_u);
  for (Index i = 1; i <= order_; ++i) v.segment((i - 1) * n_y, n_y) = outputs.col(t - i);
  for (Index i = 0; i <= order_; ++i) v.segment(order_ * n_y + i * n_u, n_u) = inputs.col(t - i);
  return (v - mean_).cwiseQuotient(scale_);
}

VectorXd PolynomialNarxModel::Monomials(const VectorXd& regressor) const {
  VectorXd monomials(1 + static_cast<Index>(products_.size()));
  monomials[0] = 1;
  for (size_t k = 0; k < products_.size(); ++k) {
    monomials[static_cast<Index>(k) + 1] = monomials[products_[k].first] * regressor[products_[k].second];
  }
  return monomials;
}

absl::StatusOr<PolynomialNarxModel> PolynomialNarxModel::Fit(const data::Trajectory& trajectory, int order, int degree) {
  if (const absl::Status status = Check(trajectory, order, degree); !status.ok()) return status;
  PolynomialNarxModel model;
  model.order_ = order;
  const Index variables = order * trajectory.outputs.rows() + (order + 1) * trajectory.inputs.rows();
  const Index rows = trajectory.length() - order;
  model.mean_ = VectorXd::Zero(variables);
  model.scale_ = VectorXd::Ones(variables);
  MatrixXd regressors(rows, variables);
  for (Index k = 0; k < rows; ++k) {
    regressors.row(k) = model.Regressor(trajectory.inputs, trajectory.outputs, k + order);
  }
  model.mean_ = regressors.colwise().mean();
  model.scale_ = Deviation(regressors, model.mean_);
  model.products_ = Products(variables, degree);
  const Index terms = 1 + static_cast<Index>(model.products_.size());
  // Below the rows of the data, those of the ridge.
  MatrixXd matrix = MatrixXd::Zero(rows + terms, terms);
  MatrixXd targets = MatrixXd::Zero(rows + terms, trajectory.outputs.rows());
  for (Index k = 0; k < rows; ++k) {
    const VectorXd v = (regressors.row(k).transpose() - model.mean_).cwiseQuotient(model.scale_);
    matrix.row(k) = model.Monomials(v);
  }
  targets.topRows(rows) = trajectory.outputs.rightCols(rows).transpose();
  VectorXd scale = matrix.colwise().norm();
  scale = (scale.array() > 0).select(scale, 1.0);
  matrix *= scale.cwiseInverse().asDiagonal();
  matrix.bottomRows(terms).diagonal().setConstant(std::sqrt(kRidge));
  const MatrixXd solution = linalg::SolveLeastSquares(std::move(matrix), targets);
  model.coefficients_ = (scale.cwiseInverse().asDiagonal() * solution).transpose();
  return model;
}

MatrixXd PolynomialNarxModel::Predict(const data::Trajectory& trajectory, bool simulate, Index warmup) const {
  const Index start = std::max<Index>(order_, warmup);
  MatrixXd prediction = MatrixXd::Constant(trajectory.outputs.rows(), trajectory.length(),
                                           std::numeric_limits<double>::quiet_NaN());
  MatrixXd outputs = trajectory.outputs;
  for (Index t = start; t < trajectory.length(); ++t) {
    const VectorXd v = Regressor(trajectory.inputs, outputs, t);
    if (simulate && !(v.head(order_ * outputs.rows()).cwiseAbs().maxCoeff() < kDiverged)) {
      prediction.rightCols(trajectory.length() - t).setConstant(std::numeric_limits<double>::infinity());
      break;
    }
    prediction.col(t) = coefficients_ * Monomials(v);
    if (simulate) outputs.col(t) = prediction.col(t);
  }
  return prediction;
}

}  // namespace metaekf::meta
