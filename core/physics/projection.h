#pragma once

#include <Eigen/Core>
#include <vector>

#include "core/physics/polyhedron.h"

namespace metaekf::physics {

/// The point of a set that is nearest to another one.
struct Projection {
  Eigen::VectorXd point;
  std::vector<Eigen::Index> active;  ///< rows of G that hold it back; empty where z was inside
};

/// argmin (x − z)ᵀ P⁻¹ (x − z) under G x ≤ g: what is most probable of N(z, P) inside the set.
///
/// With P = L Lᵀ and x = z + L y it is the y of least norm under G L y ≤ g − G z, which a nonnegative least-squares problem
/// gives; so P may be singular; where z + range(P) does not meet the set, the nearest point is taken. What is returned is inside to
/// rounding (Contains), whatever comes in: where nothing else is, it is a point of the set that does not depend on z.
///
/// @param z  n, finite. @param root  L, n × k.
/// Source: C. L. Lawson and R. J. Hanson, Solving Least Squares Problems, 1974, chapter 23 (NNLS and LDP).
Projection Project(const Polyhedron& set, const Eigen::VectorXd& z, const Eigen::MatrixXd& root);

/// The nearest point where all directions count the same, x itself if it is inside: for what rounding alone has put outside.
Eigen::VectorXd Inside(const Polyhedron& set, const Eigen::VectorXd& x);

}  // namespace metaekf::physics
