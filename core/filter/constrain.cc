#include "core/filter/constrain.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

#include "core/filter/square_root.h"
#include "core/physics/projection.h"

namespace metaekf::filter {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kTail = 20;  // beyond it 1 + α² − α φ/Φ cancels, and the series of the tail takes over

/// L with the variance along a, as seen from the edge, ρ times what it was.
void Narrow(const VectorXd& a, double outside, MatrixXd* factor) {
  const VectorXd along = factor->transpose() * a;
  const double deviation = along.norm();
  if (deviation == 0) return;
  const double rho = EdgeVariance(std::max(0.0, outside / deviation));
  const VectorXd unit = along / deviation;
  *factor -= (1 - std::sqrt(rho)) * (*factor * unit) * unit.transpose();
}

}  // namespace

double EdgeVariance(double alpha) {
  if (alpha > kTail) {
    const double square = alpha * alpha;
    return 2 / square * (1 - 5 / square + 37 / (square * square));
  }
  const double density = std::exp(-0.5 * alpha * alpha) / std::sqrt(2 * std::numbers::pi);
  const double beyond = 0.5 * std::erfc(alpha / std::numbers::sqrt2);
  return 1 + alpha * (alpha - density / beyond);
}

physics::Polyhedron InUnits(const physics::Polyhedron& set, const VectorXd& mean, const VectorXd& scale) {
  const VectorXd inverse = scale.cwiseInverse();
  physics::Polyhedron normalised{.G = set.G * scale.asDiagonal(), .g = set.g - set.G * mean, .rays = inverse.asDiagonal() * set.rays,
                                 .vertices = inverse.asDiagonal() * (set.vertices.colwise() - mean),
                                 .lineality = inverse.asDiagonal() * set.lineality};
  if (set.vertices.cols() == 0) normalised.vertices = -inverse.cwiseProduct(mean);  // the apex of a cone
  return normalised;
}

physics::Polyhedron WithFree(const physics::Polyhedron& set, Index r) {
  const Index n = set.dimension();
  const auto below = [r](const MatrixXd& columns) {
    MatrixXd whole = MatrixXd::Zero(columns.rows() + r, columns.cols());
    whole.topRows(columns.rows()) = columns;
    return whole;
  };
  physics::Polyhedron free{.G = MatrixXd::Zero(set.G.rows(), n + r), .g = set.g, .rays = below(set.rays), .vertices = below(set.vertices),
                           .lineality = MatrixXd::Zero(n + r, set.lineality.cols() + r)};
  free.G.leftCols(n) = set.G;
  free.lineality.topLeftCorner(set.lineality.rows(), set.lineality.cols()) = set.lineality;
  free.lineality.bottomRightCorner(r, r).setIdentity();
  return free;
}

double Slack(const physics::Polyhedron& set, const VectorXd& x) {
  double slack = std::numeric_limits<double>::infinity();
  for (Index i = 0; i < set.g.size(); ++i) {
    const double length = set.G.row(i).norm();
    if (length > 0) slack = std::min(slack, (set.g[i] - set.G.row(i).dot(x)) / length);
  }
  return slack;
}

ConstraintEffect Constrain(const physics::Polyhedron& set, VectorXd* mean, MatrixXd* factor) {
  ConstraintEffect effect{.slack = Slack(set, *mean)};
  if (physics::Contains(set, *mean)) return effect;
  const VectorXd outside = set.G * *mean - set.g;
  const physics::Projection projection = physics::Project(set, *mean, *factor);
  effect.projection = (projection.point - *mean).norm();
  *mean = projection.point;
  for (const Index row : projection.active) Narrow(set.G.row(row).transpose(), outside[row], factor);
  LowerTriangularise(*factor);
  return effect;
}

}  // namespace metaekf::filter
