#include "core/filter/square_root.h"

#include <algorithm>
#include <cmath>

#include "absl/strings/str_cat.h"

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;

namespace {

constexpr Index kRowsAtATime = 32;
constexpr double kLeastSquare = 1e-280;  // of a row's tail: what is less than 1e-140 is nothing beside any covariance, and would not divide

/// Rows r ← r − γ (r v) vᵀ, for `count` of them, at most kRowsAtATime, and v in columns i … cols − 1. The count is kRows where that is
/// known when this is compiled: small filters are made of such loops.
/// @param rows  the first of them in column 0. @param v  v_i first, `ld` elements from one to the next; v_i itself is `v0`.
template <Index kRows>
void Reflect(double* rows, Index count, Index ld, Index i, Index cols, double v0, const double* v, double gamma) {
  if constexpr (kRows > 0) count = kRows;
  double dots[kRows > 0 ? kRows : kRowsAtATime];
  double* const column_i = rows + i * ld;
  for (Index k = 0; k < count; ++k) dots[k] = 0;
  // Down the columns, as they lie in memory.
  for (Index j = 1; j < cols - i; ++j) {
    const double factor = v[j * ld];
    const double* const column = column_i + j * ld;
    for (Index k = 0; k < count; ++k) dots[k] += column[k] * factor;
  }
  for (Index k = 0; k < count; ++k) {
    dots[k] = (dots[k] + column_i[k] * v0) * gamma;
    column_i[k] -= dots[k] * v0;
  }
  for (Index j = 1; j < cols - i; ++j) {
    const double factor = v[j * ld];
    double* const column = column_i + j * ld;
    for (Index k = 0; k < count; ++k) column[k] -= dots[k] * factor;
  }
}

}  // namespace

void LowerTriangularise(Ref<MatrixXd> a) {
  const Index rows = a.rows(), ld = a.outerStride();
  double* const data = a.data();
  for (Index i = 0; i < rows; ++i) {
    double* const row = data + i;
    // Columns that have nothing in row i stay as they are; behind a time update's Q^½, whose columns begin one after the other,
    // that is half of the work.
    Index cols = a.cols();
    while (cols > i + 1 && row[(cols - 1) * ld] == 0) --cols;
    // A reflection I − γ v vᵀ of columns i … that maps row i's tail onto its norm e₁: v = (head − norm, rest), γ = 2 / vᵀv = −1 / (norm v₀).
    double squared = 0;
    for (Index j = i + 1; j < cols; ++j) squared += row[j * ld] * row[j * ld];
    double& diagonal = row[i * ld];
    const double head = diagonal;
    if (squared >= kLeastSquare) {
      const double norm = std::sqrt(head * head + squared);
      const bool turns = head <= 0;  // else head − norm would cancel
      const double v0 = turns ? head - norm : -squared / (head + norm);
      const double gamma = turns ? -1 / (norm * v0) : (head + norm) / (norm * squared);
      const Index below = rows - i - 1;
      double* const first = row + 1;
      const double* const v = &diagonal;
      switch (below) {
        case 0:
          break;
        case 1:
          Reflect<1>(first, 1, ld, i, cols, v0, v, gamma);
          break;
        case 2:
          Reflect<2>(first, 2, ld, i, cols, v0, v, gamma);
          break;
        case 3:
          Reflect<3>(first, 3, ld, i, cols, v0, v, gamma);
          break;
        case 4:
          Reflect<4>(first, 4, ld, i, cols, v0, v, gamma);
          break;
        default:
          for (Index k = 0; k < below; k += kRowsAtATime) {
            Reflect<0>(first + k, std::min(kRowsAtATime, below - k), ld, i, cols, v0, v, gamma);
          }
      }
      diagonal = norm;
    } else if (head < 0) {
      for (Index k = i; k < rows; ++k) data[k + i * ld] = -data[k + i * ld];
    }
    for (Index j = i + 1; j < cols; ++j) row[j * ld] = 0;
  }
}

absl::StatusOr<MatrixXd> SemidefiniteFactor(const MatrixXd& a) {
  const Index n = a.rows();
  if (a.cols() != n) return absl::InvalidArgumentError(absl::StrCat("a covariance must be square, got ", n, " × ", a.cols()));
  if (!a.allFinite()) return absl::InvalidArgumentError("a covariance must be finite");
  const double scale = n > 0 ? a.diagonal().cwiseAbs().maxCoeff() : 0;
  // Rounding is judged by each quantity's own variance: their units may be far apart.
  const double relative = 1e-12 * static_cast<double>(n), least = 1e-12 * relative * scale;
  if (!(a - a.transpose()).isZero(1e-9 * scale)) return absl::InvalidArgumentError("a covariance must be symmetric");
  MatrixXd l = MatrixXd::Zero(n, n);
  for (Index j = 0; j < n; ++j) {
    double pivot = a(j, j);
    for (Index k = 0; k < j; ++k) pivot -= l(j, k) * l(j, k);
    const double tolerance = std::max(least, relative * a(j, j));
    if (pivot < -tolerance) {
      return absl::InvalidArgumentError(absl::StrCat("a covariance must be positive semidefinite; pivot ", j, " is ", pivot));
    }
    const bool zero = pivot <= tolerance;
    l(j, j) = zero ? 0 : std::sqrt(pivot);
    for (Index i = j + 1; i < n; ++i) {
      double rest = a(i, j);
      for (Index k = 0; k < j; ++k) rest -= l(i, k) * l(j, k);
      // A direction without variance has no covariance with others either.
      if (zero && std::fabs(rest) > std::sqrt(relative * std::max(a(i, i), least) * std::max(a(j, j), least)) + least) {
        return absl::InvalidArgumentError(absl::StrCat("a covariance must be positive semidefinite; see row ", i));
      }
      l(i, j) = zero ? 0 : rest / l(j, j);
    }
  }
  return l;
}

void FactorTimeUpdate(const MatrixXd& F, const MatrixXd& process_factor, MatrixXd* work, MatrixXd* factor) {
  const Index n = factor->rows();
  for (Index j = 0; j < n; ++j) {
    work->col(j) = (*factor)(j, j) * F.col(j);
    for (Index k = j + 1; k < n; ++k) work->col(j) += (*factor)(k, j) * F.col(k);
  }
  work->rightCols(n) = process_factor;
  LowerTriangularise(*work);
  *factor = work->leftCols(n);
}

void FactorMeasurementUpdate(const Ref<const MatrixXd>& H_rows, Ref<MatrixXd> work, MatrixXd* factor) {
  const Index m = H_rows.rows(), n = factor->rows();
  work.topRightCorner(m, n).noalias() = H_rows.lazyProduct(*factor);
  work.bottomLeftCorner(n, m).setZero();
  work.bottomRightCorner(n, n) = *factor;
  LowerTriangularise(work);
  *factor = work.bottomRightCorner(n, n);
}

}  // namespace metaekf::filter
