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

}  // namespace

void LowerTriangularise(Ref<MatrixXd> a) {
  const Index rows = a.rows();
  for (Index i = 0; i < rows; ++i) {
    // Columns that have nothing in row i stay as they are; behind a time update's Q^½, whose columns begin one after the other,
    // that is half of the work.
    Index cols = a.cols();
    while (cols > i + 1 && a(i, cols - 1) == 0) --cols;
    // A reflection of columns i … that maps row i's tail onto ± its norm e₁.
    double squared = 0;
    for (Index j = i + 1; j < cols; ++j) squared += a(i, j) * a(i, j);
    const double head = a(i, i);
    if (squared > 0) {
      const double norm = std::sqrt(head * head + squared);
      const double v0 = head <= 0 ? head - norm : -squared / (head + norm);  // no cancellation
      const double beta = 2 * v0 * v0 / (squared + v0 * v0);
      const double inverse = 1 / v0;
      for (Index j = i + 1; j < cols; ++j) a(i, j) *= inverse;  // the reflection's vector is (1, this)
      // Down the columns, as they lie in memory, for some rows at a time.
      for (Index first = i + 1; first < rows; first += kRowsAtATime) {
        const Index count = std::min(kRowsAtATime, rows - first);
        double dots[kRowsAtATime];
        for (Index k = 0; k < count; ++k) dots[k] = a(first + k, i);
        for (Index j = i + 1; j < cols; ++j) {
          const double factor = a(i, j);
          const double* column = &a(first, j);
          for (Index k = 0; k < count; ++k) dots[k] += column[k] * factor;
        }
        for (Index k = 0; k < count; ++k) a(first + k, i) -= dots[k] *= beta;
        for (Index j = i + 1; j < cols; ++j) {
          const double factor = a(i, j);
          double* column = &a(first, j);
          for (Index k = 0; k < count; ++k) column[k] -= dots[k] * factor;
        }
      }
      a(i, i) = norm;
      for (Index j = i + 1; j < cols; ++j) a(i, j) = 0;
    } else if (head < 0) {
      for (Index k = i; k < rows; ++k) a(k, i) = -a(k, i);
    }
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
