#include "core/physics/projection.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

#include "core/linalg/decompositions.h"

namespace metaekf::physics {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kEpsilon = std::numeric_limits<double>::epsilon();
constexpr double kOptimal = 1e-12;  // of |E||f|: what a gradient may be at the minimum
constexpr double kAtApex = 1e-12;   // of |z|: what is left of a point that is 0
constexpr int kRetreats = 8;        // of planes that are moved inwards until rounding does no harm

/// u ≥ 0 that minimises |E u − f|, by Lawson and Hanson's active sets.
class NonNegativeLeastSquares {
 public:
  NonNegativeLeastSquares(const MatrixXd& E, const VectorXd& f) : E_(E), f_(f), u_(VectorXd::Zero(E.cols())) {
    std::vector<bool> barred(static_cast<size_t>(E.cols()), false);
    const Index most = 3 * E.cols() + 10;  // rounding may let it circle
    for (Index step = 0; step < most; ++step) {
      const Index column = Steepest(barred);
      if (column < 0) break;
      passive_.push_back(column);
      const bool stayed = Settle(column);
      // What rounding alone has made steep is not tried again before something has changed.
      if (stayed) std::fill(barred.begin(), barred.end(), false);
      barred[static_cast<size_t>(column)] = !stayed;
    }
  }

  const VectorXd& u() const { return u_; }
  /// The columns that are used.
  const std::vector<Index>& passive() const { return passive_; }

 private:
  Index Steepest(const std::vector<bool>& barred) const {
    const VectorXd descent = E_.transpose() * (f_ - E_ * u_);
    Index steepest = -1;
    for (Index i = 0; i < descent.size(); ++i) {
      if (barred[static_cast<size_t>(i)] || std::find(passive_.begin(), passive_.end(), i) != passive_.end()) continue;
      if (!(descent[i] > kOptimal * E_.col(i).norm() * f_.norm())) continue;
      if (steepest < 0 || descent[i] > descent[steepest]) steepest = i;
    }
    return steepest;
  }

  /// Goes to the minimum over the passive columns, letting go of those whose u gets to 0 on the way. Whether `added` has stayed.
  bool Settle(Index added) {
    while (!passive_.empty()) {
      const VectorXd target = linalg::SolveLeastSquares(E_(Eigen::all, passive_), MatrixXd(f_));
      double share = 1;
      size_t blocking = passive_.size();
      for (size_t k = 0; k < passive_.size(); ++k) {
        const double from = u_[passive_[k]], to = target[static_cast<Index>(k)];
        if (to > 0) continue;
        const double reach = from > 0 ? from / (from - to) : 0;
        if (reach > share) continue;
        share = reach;
        blocking = k;
      }
      for (size_t k = 0; k < passive_.size(); ++k) {
        double& value = u_[passive_[k]];
        value += share * (target[static_cast<Index>(k)] - value);
      }
      if (blocking == passive_.size()) break;
      u_[passive_[blocking]] = 0;
      passive_.erase(passive_.begin() + static_cast<std::ptrdiff_t>(blocking));
    }
    return std::find(passive_.begin(), passive_.end(), added) != passive_.end();
  }

  const MatrixXd& E_;
  const VectorXd& f_;
  VectorXd u_;
  std::vector<Index> passive_;
};

/// Rows that hold back the y of least norm under A y ≤ b, some b negative.
///
/// With E = [−Aᵀ; −bᵀ] and f = e_{n+1} the residual r = E u − f of the nonnegative least squares u gives y = −r_{1…n} / r_{n+1}.
std::vector<Index> ActiveRows(const MatrixXd& A, const VectorXd& b) {
  MatrixXd E(A.cols() + 1, A.rows());
  const double size = -b.minCoeff();  // y in units of the worst violation, small beside the room of others as it may be
  for (Index i = 0; i < A.rows(); ++i) {
    const double length = std::max(A.row(i).norm(), std::fabs(b[i]) / size);  // a row times a number is the same row
    E.col(i) << -A.row(i).transpose(), -b[i] / size;
    if (length > 0) E.col(i) /= length;
  }
  VectorXd f = VectorXd::Zero(A.cols() + 1);
  f[A.cols()] = 1;
  return NonNegativeLeastSquares(E, f).passive();
}

/// A point of the set, the middle of its vertices if rounding lets it.
VectorXd Anchor(const Polyhedron& set) {
  if (set.vertices.cols() == 0) return VectorXd::Zero(set.dimension());
  const VectorXd middle = set.vertices.rowwise().mean();
  if (Contains(set, middle)) return middle;
  for (Index k = 0; k < set.vertices.cols(); ++k) {
    if (Contains(set, set.vertices.col(k))) return set.vertices.col(k);
  }
  return VectorXd::Zero(set.dimension());
}

/// The nearest point of z + range(root), in the norm of the y of z + root y. Nothing if rounding leaves it outside.
std::optional<Projection> ProjectAlong(const Polyhedron& set, const VectorXd& z, const MatrixXd& root) {
  const MatrixXd A = set.G * root;
  const VectorXd sizes = set.G.cwiseAbs() * z.cwiseAbs() + set.g.cwiseAbs();  // of the terms that rounding errors come from
  Projection result;
  for (int retreat = 0; retreat < kRetreats; ++retreat) {
    const VectorXd room = set.g - set.G * z - (retreat == 0 ? 0 : kEpsilon * std::pow(8.0, retreat)) * sizes;
    if (!(room.minCoeff() < 0)) continue;  // outside by a rounding error that this room does not show
    result.active = ActiveRows(A, room);
    // On the planes of those rows, G_S (z + root y) = g_S, to the last digits.
    const MatrixXd planes = A(result.active, Eigen::all);
    result.point = z + root * VectorXd(linalg::SolveLeastSquares(planes, MatrixXd(room(result.active))));
    if (!result.point.allFinite()) continue;
    if (Contains(set, result.point)) return result;
    // An apex of 0 is met by no sum whose terms cancel, and is itself inside.
    if (set.vertices.cols() == 0 && result.point.norm() <= kAtApex * z.norm()) return Projection{VectorXd::Zero(z.size()), result.active};
  }
  return std::nullopt;
}

}  // namespace

Projection Project(const Polyhedron& set, const VectorXd& z, const MatrixXd& root) {
  if (Contains(set, z)) return {z, {}};
  if (std::optional<Projection> found = ProjectAlong(set, z, root)) return *found;
  if (std::optional<Projection> found = ProjectAlong(set, z, MatrixXd::Identity(z.size(), z.size()))) return *found;
  return {Anchor(set), {}};
}

VectorXd Inside(const Polyhedron& set, const VectorXd& x) {
  if (Contains(set, x)) return x;
  return Project(set, x, MatrixXd::Identity(x.size(), x.size())).point;
}

}  // namespace metaekf::physics
