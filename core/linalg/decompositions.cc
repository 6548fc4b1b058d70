#include "core/linalg/decompositions.h"

#include <algorithm>
#include <limits>
#include <utility>
#include <vector>

#include "core/linalg/blas.h"

// LAPACK, as OpenBLAS exports it: Fortran, everything by reference, sizes 32 bits. OpenBLAS installs no header for it.
extern "C" {
void dpotrf_(const char* uplo, const int* n, double* a, const int* lda, int* info);
void dpotrs_(const char* uplo, const int* n, const int* nrhs, const double* a, const int* lda, double* b, const int* ldb,
             int* info);
void dpotri_(const char* uplo, const int* n, double* a, const int* lda, int* info);
void dgesdd_(const char* jobz, const int* m, const int* n, double* a, const int* lda, double* s, double* u, const int* ldu,
             double* vt, const int* ldvt, double* work, const int* lwork, int* iwork, int* info);
void dsyevd_(const char* jobz, const char* uplo, const int* n, double* a, const int* lda, double* w, double* work,
             const int* lwork, int* iwork, const int* liwork, int* info);
void dgeev_(const char* jobvl, const char* jobvr, const int* n, double* a, const int* lda, double* wr, double* wi, double* vl,
            const int* ldvl, double* vr, const int* ldvr, double* work, const int* lwork, int* info);
void dgelsy_(const int* m, const int* n, const int* nrhs, double* a, const int* lda, double* b, const int* ldb, int* jpvt,
             const double* rcond, int* rank, double* work, const int* lwork, int* info);
}

namespace metaekf::linalg {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

int Int(Index size) { return static_cast<int>(size); }
int Leading(const MatrixXd& matrix) { return std::max(1, Int(matrix.rows())); }

/// Calls a routine twice: for the size of its workspace, and for its work.
template <typename Routine>
void WithWorkspace(Routine routine) {
  double best = 0;
  routine(&best, -1);
  std::vector<double> work(static_cast<size_t>(best));
  routine(work.data(), static_cast<int>(work.size()));
}

}  // namespace

Cholesky::Cholesky(MatrixXd a) : lower_(std::move(a)) {
  const int n = Int(lower_.rows()), lda = Leading(lower_);
  int info = 0;
  dpotrf_("L", &n, lower_.data(), &lda, &info);
  ok_ = info == 0 && lower_.diagonal().allFinite();  // OpenBLAS takes NaN for positive
}

void Cholesky::SolveInPlace(Index columns, double* b) const {
  const int n = Int(lower_.rows()), lda = Leading(lower_), count = Int(columns);
  int info = 0;
  dpotrs_("L", &n, &count, lower_.data(), &lda, b, &lda, &info);
}

MatrixXd Cholesky::Solve(MatrixXd b) const {
  SolveInPlace(b.cols(), b.data());
  return b;
}

VectorXd Cholesky::Solve(VectorXd b) const {
  SolveInPlace(1, b.data());
  return b;
}

MatrixXd Cholesky::Inverse() const {
  MatrixXd inverse = lower_;
  const int n = Int(inverse.rows()), lda = Leading(inverse);
  int info = 0;
  dpotri_("L", &n, inverse.data(), &lda, &info);
  return inverse.selfadjointView<Eigen::Lower>();
}

SingularValues DecomposeSingularValues(MatrixXd a) {
  const Index m = a.rows(), n = a.cols(), k = std::min(m, n);
  SingularValues result{.u = MatrixXd(m, k), .values = VectorXd(k)};
  MatrixXd transposed(k, n);
  const int rows = Int(m), cols = Int(n), lda = Leading(a), ldvt = Leading(transposed);
  std::vector<int> integers(static_cast<size_t>(8 * std::max<Index>(1, k)));
  int info = 0;
  WithWorkspace([&](double* work, int size) {
    dgesdd_("S", &rows, &cols, a.data(), &lda, result.values.data(), result.u.data(), &lda, transposed.data(), &ldvt, work,
            &size, integers.data(), &info);
  });
  result.v = transposed.transpose();
  if (info != 0) result.values.setConstant(kNan);
  return result;
}

SymmetricEigen DecomposeSymmetric(MatrixXd a) {
  const int n = Int(a.rows()), lda = Leading(a), integers = 3 + 5 * n;
  SymmetricEigen result{.values = VectorXd(n)};
  std::vector<int> workspace(static_cast<size_t>(integers));
  int info = 0;
  WithWorkspace([&](double* work, int size) {
    dsyevd_("V", "L", &n, a.data(), &lda, result.values.data(), work, &size, workspace.data(), &integers, &info);
  });
  result.vectors = std::move(a);
  if (info != 0) result.values.setConstant(kNan);
  return result;
}

Eigen::VectorXcd Eigenvalues(MatrixXd a) {
  const int n = Int(a.rows()), lda = Leading(a), one = 1;
  VectorXd real(n), imaginary(n);
  int info = 0;
  WithWorkspace([&](double* work, int size) {
    dgeev_("N", "N", &n, a.data(), &lda, real.data(), imaginary.data(), nullptr, &one, nullptr, &one, work, &size, &info);
  });
  Eigen::VectorXcd values(n);
  values.real() = real;
  values.imag() = imaginary;
  if (info != 0) values.setConstant(kNan);
  return values;
}

MatrixXd SolveLeastSquares(MatrixXd a, const MatrixXd& b) {
  const Index m = a.rows(), n = a.cols();
  MatrixXd solution = MatrixXd::Zero(std::max(m, n), b.cols());
  solution.topRows(m) = b;
  const int rows = Int(m), cols = Int(n), count = Int(b.cols()), lda = Leading(a), ldb = Leading(solution);
  const double smallest = std::numeric_limits<double>::epsilon() * static_cast<double>(std::max(m, n));
  std::vector<int> pivots(static_cast<size_t>(n), 0);
  int rank = 0, info = 0;
  WithWorkspace([&](double* work, int size) {
    dgelsy_(&rows, &cols, &count, a.data(), &lda, solution.data(), &ldb, pivots.data(), &smallest, &rank, work, &size, &info);
  });
  return solution.topRows(n);
}

}  // namespace metaekf::linalg
