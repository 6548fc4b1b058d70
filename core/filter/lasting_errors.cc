#include "core/filter/lasting_errors.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <numeric>

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kLeastShare = 0.1, kLargestShare = 0.99;
constexpr double kShortest = 0.5, kLongest = 200, kStep = 1.05;  // time constants that are tried, in samples

/// φ whose powers fit a_1 … a_K best; 0 where none fits better than nothing does.
double CorrelationOf(const VectorXd& autocorrelation) {
  double best = 0, most = 0;
  for (double samples = kShortest; samples <= kLongest; samples *= kStep) {
    const double correlation = std::exp(-1 / samples);
    double along = 0, square = 0, power = 1;
    for (const double a : autocorrelation) {
      power *= correlation;
      along += a * power;
      square += power * power;
    }
    // What a least-squares fit of one factor takes away from Σ a².
    if (along > 0 && along * along / square > most) most = along * along / square, best = correlation;
  }
  return best;
}

}  // namespace

SplitErrors SplitByDuration(const std::vector<MatrixXd>& moments) {
  const MatrixXd& C0 = moments[0];
  const Index n = C0.rows(), lags = static_cast<Index>(moments.size()) - 1;
  SplitErrors split{.lasting = {.loadings = MatrixXd(n, 0)}, .white = C0};
  VectorXd autocorrelation(lags);
  for (Index k = 1; k <= lags; ++k) autocorrelation[k - 1] = moments[static_cast<size_t>(k)].diagonal().cwiseQuotient(C0.diagonal()).mean();
  const double correlation = CorrelationOf(autocorrelation);
  if (correlation == 0) return split;
  MatrixXd B = MatrixXd::Zero(n, n);
  double square = 0, power = 1;
  for (Index k = 1; k <= lags; ++k) {
    power *= correlation;
    const MatrixXd& C = moments[static_cast<size_t>(k)];
    B += 0.5 * power * (C + C.transpose());
    square += power * power;
  }
  B /= square;
  const Eigen::LLT<MatrixXd> root(C0);
  const MatrixXd half = root.matrixL().solve(B);
  const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(MatrixXd(root.matrixL().solve(half.transpose())));
  const MatrixXd directions = root.matrixL() * eigen.eigenvectors();
  std::vector<Index> kept;
  for (Index i = 0; i < n; ++i) {
    if (eigen.eigenvalues()[i] >= kLeastShare) kept.push_back(i);
  }
  const auto size = [&](Index i) { return directions.col(i).squaredNorm() * eigen.eigenvalues()[i]; };
  std::sort(kept.begin(), kept.end(), [&](Index a, Index b) { return size(a) > size(b); });
  if (static_cast<Index>(kept.size()) > kMostLastingErrors) kept.resize(kMostLastingErrors);
  if (kept.empty()) return split;
  split.lasting = {.loadings = MatrixXd(n, static_cast<Index>(kept.size())), .correlation = correlation};
  for (size_t k = 0; k < kept.size(); ++k) {
    const double share = std::min(eigen.eigenvalues()[kept[k]], kLargestShare);
    split.lasting.loadings.col(static_cast<Index>(k)) = std::sqrt(share) * directions.col(kept[k]);
  }
  split.white -= split.lasting.loadings * split.lasting.loadings.transpose();
  return split;
}

}  // namespace metaekf::filter
