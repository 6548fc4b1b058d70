#include "core/filter/square_root.h"

#include <algorithm>
#include <cmath>

#include "absl/strings/str_cat.h"
#include "core/base/with_count.h"

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::Ref;

namespace {

constexpr Index kRowsAtATime = 32;
constexpr double kLeastSquare = 1e-280;  // of a row's tail: what is less than 1e-140 is nothing beside any covariance, and would not divide

/// Rows r ← r (I − γ v vᵀ) from column i on, for `count` of them, at most kRowsAtATime; then r_i ← −sign r_i. The count is kRows where
/// that is known when this is compiled: small filters are made of such loops.
/// @param rows  the first of them in column i, `ld` elements from one column to the next. @param v  v_i first, in a row of the same
/// matrix; v_i itself is `v0`. @param length  of v.
template <Index kRows>
void Reflect(double* rows, Index count, Index ld, Index length, double sign, double v0, const double* v, double gamma) {
  if constexpr (kRows > 0) count = kRows;
  double dots[kRows > 0 ? kRows : kRowsAtATime];
  for (Index k = 0; k < count; ++k) dots[k] = rows[k] * v0;
  // Down the columns, as they lie in memory.
  for (Index j = 1; j < length; ++j) {
    const double factor = v[j * ld];
    const double* const column = rows + j * ld;
    for (Index k = 0; k < count; ++k) dots[k] += column[k] * factor;
  }
  for (Index k = 0; k < count; ++k) {
    dots[k] *= gamma;
    rows[k] = sign * (dots[k] * v0 - rows[k]);
  }
  for (Index j = 1; j < length; ++j) {
    const double factor = v[j * ld];
    double* const column = rows + j * ld;
    for (Index k = 0; k < count; ++k) column[k] -= dots[k] * factor;
  }
}

/// Makes row i zero behind the diagonal, which becomes non-negative, by one reflection of the columns from i on.
/// @param diagonal  row i's. @param length  of the row from there on. @param below  rows below; kBelow where that is known.
template <Index kBelow>
void Eliminate(double* diagonal, Index ld, Index length, Index below) {
  if constexpr (kBelow >= 0) below = kBelow;
  // Columns that have nothing in this row stay as they are; behind a time update's Q^½, whose columns begin one after the other,
  // that is half of the work.
  while (length > 1 && diagonal[(length - 1) * ld] == 0) --length;
  double squared = 0;
  for (Index j = 1; j < length; ++j) squared += diagonal[j * ld] * diagonal[j * ld];
  const double head = *diagonal, sign = std::copysign(1.0, head);
  if (squared >= kLeastSquare) {
    // I − γ v vᵀ maps the row onto −sign(head) norm e₁ with v = (head + sign(head) norm, rest), in which nothing cancels, and
    // γ = 2 / vᵀv = 1 / (norm (norm + |head|)).
    const double norm = std::sqrt(head * head + squared), v0 = head + sign * norm;
    const double gamma = 1 / (norm * (norm + std::fabs(head)));
    if constexpr (kBelow > 0) {
      Reflect<kBelow>(diagonal + 1, below, ld, length, sign, v0, diagonal, gamma);
    } else {
      for (Index k = 0; k < below; k += kRowsAtATime) {
        Reflect<0>(diagonal + 1 + k, std::min(kRowsAtATime, below - k), ld, length, sign, v0, diagonal, gamma);
      }
    }
    *diagonal = norm;
  } else {
    for (Index k = 0; k <= below; ++k) diagonal[k] *= sign;
  }
  for (Index j = 1; j < length; ++j) diagonal[j * ld] = 0;
}

/// A L from a lower triangular L, n × n.
/// @param a  rows × n, `lda` from one column to the next; so is `product`, with `ld`.
void TimesTriangular(const double* a, Index all_rows, Index lda, const MatrixXd& l, double* product, Index ld) {
  base::WithCount(all_rows, [&](auto rows) {
    const Index n = l.rows();
    for (Index j = 0; j < n; ++j, product += ld) {
      const double* column = a + j * lda;
      double factor = l(j, j);
      for (Index i = 0; i < rows; ++i) product[i] = factor * column[i];
      for (Index k = j + 1; k < n; ++k) {
        column += lda;
        factor = l(k, j);
        for (Index i = 0; i < rows; ++i) product[i] += factor * column[i];
      }
    }
  });
}

}  // namespace

void LowerTriangularise(Ref<MatrixXd> a) {
  const Index rows = a.rows(), ld = a.outerStride();
  double* diagonal = a.data();
  Index length = a.cols(), below = rows - 1;
  const auto next = [&] { diagonal += ld + 1, --length, --below; };
  while (below > 4) Eliminate<-1>(diagonal, ld, length, below), next();
  switch (below) {
    case 4:
      Eliminate<4>(diagonal, ld, length, 4), next();
      [[fallthrough]];
    case 3:
      Eliminate<3>(diagonal, ld, length, 3), next();
      [[fallthrough]];
    case 2:
      Eliminate<2>(diagonal, ld, length, 2), next();
      [[fallthrough]];
    case 1:
      Eliminate<1>(diagonal, ld, length, 1), next();
      [[fallthrough]];
    case 0:
      Eliminate<0>(diagonal, ld, length, 0);
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
  TimesTriangular(F.data(), n, n, *factor, work->data(), n);
  std::copy_n(process_factor.data(), n * n, work->data() + n * n);
  LowerTriangularise(*work);
  std::copy_n(work->data(), n * n, factor->data());
}

void FactorMeasurementUpdate(const Ref<const MatrixXd>& H_rows, Ref<MatrixXd> work, MatrixXd* factor) {
  const Index m = H_rows.rows(), n = factor->rows(), ld = work.outerStride();
  double* column = work.data();
  for (Index j = 0; j < m; ++j, column += ld) std::fill_n(column + m, n, 0.0);
  TimesTriangular(H_rows.data(), m, H_rows.outerStride(), *factor, column, ld);
  const double* from = factor->data();
  for (Index j = 0; j < n; ++j) std::copy_n(from + j * n, n, column + j * ld + m);
  LowerTriangularise(work);
  double* to = factor->data();
  for (Index j = 0; j < n; ++j) std::copy_n(column + j * ld + m, n, to + j * n);
}

}  // namespace metaekf::filter
