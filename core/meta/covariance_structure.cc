#include "core/meta/covariance_structure.h"

#include <algorithm>
#include <cmath>

#include "absl/strings/str_cat.h"
#include "core/linalg/decompositions.h"

namespace metaekf::meta {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kLeastShare = 1e-6;  // of a parameter's variance that is its own

/// Makes V the best for D. @return ℓ there.
double UpdateLoadings(const MatrixXd& second_moment, FactorModel* model) {
  const Index p = second_moment.rows(), rank = model->loadings.cols();
  const VectorXd root = model->diagonal.cwiseSqrt(), inverse_root = root.cwiseInverse();
  const MatrixXd scaled = inverse_root.asDiagonal() * second_moment * inverse_root.asDiagonal();
  const linalg::SymmetricEigen eigen = linalg::DecomposeSymmetric(scaled);
  double twice_negative = model->diagonal.array().log().sum();
  for (Index i = 0; i < p; ++i) {  // from the largest on
    const double theta = eigen.values[p - 1 - i];
    const double excess = i < rank ? std::max(theta - 1, 0.0) : 0;
    if (i < rank) model->loadings.col(i) = std::sqrt(excess) * root.cwiseProduct(eigen.vectors.col(p - 1 - i));
    twice_negative += excess > 0 ? std::log(theta) + 1 : theta;
  }
  return -0.5 * twice_negative;
}

/// Makes every element of D in turn the best for all else. @return the largest change, relative.
double UpdateDiagonal(const MatrixXd& second_moment, FactorModel* model) {
  MatrixXd precision = model->Precision();
  double largest = 0;
  for (Index j = 0; j < second_moment.rows(); ++j) {
    const VectorXd column = precision.col(j);
    const double k = column[j], spread = column.dot(second_moment * column);
    const double last = model->diagonal[j];
    const double next = std::max(last + (spread / k - 1) / k, kLeastShare * second_moment(j, j));
    const double change = next - last;
    model->diagonal[j] = next;
    precision.noalias() -= (change / (1 + change * k) * column) * column.transpose();
    largest = std::max(largest, std::fabs(change) / next);
  }
  return largest;
}

MatrixXd BlockDiagonal(const nn::Pieces& tensors, const MatrixXd& matrix) {
  MatrixXd blocks = MatrixXd::Zero(matrix.rows(), matrix.cols());
  Index from = 0;
  for (const auto& [offset, size] : tensors) {
    blocks.block(from, from, size, size) = matrix.block(from, from, size, size);
    from += size;
  }
  return blocks;
}

}  // namespace

MatrixXd FactorModel::Covariance() const {
  MatrixXd covariance = loadings * loadings.transpose();
  covariance.diagonal() += diagonal;
  return covariance;
}

MatrixXd FactorModel::Precision() const {
  const MatrixXd scaled = diagonal.cwiseInverse().asDiagonal() * loadings;
  const Index rank = loadings.cols();
  const MatrixXd inner = MatrixXd::Identity(rank, rank) + loadings.transpose() * scaled;
  MatrixXd precision = -scaled * linalg::Cholesky(inner).Solve(MatrixXd(scaled.transpose()));
  precision.diagonal() += diagonal.cwiseInverse();
  return precision;
}

FactorModel FitFactors(const MatrixXd& second_moment, Index rank, const FactorOptions& options) {
  FactorModel model{.loadings = MatrixXd::Zero(second_moment.rows(), rank), .diagonal = 0.5 * second_moment.diagonal()};
  model.log_likelihoods.push_back(UpdateLoadings(second_moment, &model));
  for (int i = 0; i < options.max_iterations; ++i) {
    const double change = UpdateDiagonal(second_moment, &model);
    model.log_likelihoods.push_back(UpdateLoadings(second_moment, &model));
    if (change <= options.tolerance) break;
  }
  return model;
}

StructuredCovariance FitStructure(const GaussianPriorSpec& spec, const nn::Pieces& tensors, const MatrixXd& second_moment) {
  switch (spec.covariance) {
    case PriorCovariance::kFull:
      break;
    case PriorCovariance::kBlock:
      return {.covariance = BlockDiagonal(tensors, second_moment)};
    case PriorCovariance::kLowRank:
    case PriorCovariance::kManifold: {
      const FactorModel model = FitFactors(second_moment, spec.rank);
      const Index used = (model.loadings.colwise().squaredNorm().array() > 0).count();  // the largest come first
      return {model.Covariance(), model.loadings.leftCols(used)};
    }
  }
  return {.covariance = second_moment};
}

absl::Status CheckStructure(const GaussianPriorSpec& spec, Index parameters) {
  if (spec.rank <= parameters) return absl::OkStatus();  // 0 where there are no factors
  return absl::InvalidArgumentError(
      absl::StrCat("gaussian_prior.rank: ", spec.rank, " is more than the ", parameters, " parameters that adapt"));
}

}  // namespace metaekf::meta
