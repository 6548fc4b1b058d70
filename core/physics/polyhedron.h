#pragma once

#include <Eigen/Core>

#include "absl/status/statusor.h"

namespace metaekf::physics {

/// A set {x : G x ≤ g}, and what it is made of:
///
///   { R μ + V λ + L ν :  μ ≥ 0,  λ ≥ 0,  Σ λ = 1 }
///
/// R (n × r) are the rays of its pointed part, V (n × v) its vertices, L (n × l) an orthonormal basis of the directions that are
/// free both ways. R and V are orthogonal to L, and none of them can be left out. The largest element of a ray is 1 or −1. A cone
/// (g = 0) has no vertex but 0, which is not listed: v = 0.
/// Source: paper.tex eq. polyhedron and its footnote (Minkowski–Weyl).
struct Polyhedron {
  Eigen::MatrixXd G;  ///< m × n
  Eigen::VectorXd g;  ///< m
  Eigen::MatrixXd rays, vertices, lineality;

  Eigen::Index dimension() const { return G.cols(); }
};

/// Finds rays, vertices and lineality by the double description method (T. S. Motzkin et al., 1953; K. Fukuda and A. Prodon,
/// Double description method revisited, 1996): the set is the slice t = 1 of the cone {(x, t) : G x − g t ≤ 0, t ≥ 0}, whose
/// extreme rays are found constraint by constraint, each new ray where an edge between two old ones meets the constraint.
///
/// @param G  m × n, m may be 0. Rows that say nothing are welcome. @param g  m.
/// Errors: InvalidArgument if a number is not finite, shapes disagree, the set is empty (naming the first row that excludes all
/// that the rows before it allow) or needs more than 1,024 rays.
absl::StatusOr<Polyhedron> MakePolyhedron(const Eigen::MatrixXd& G, const Eigen::VectorXd& g);

/// The cone of all R μ, μ ≥ 0, with the G that describes it. @param R  n × r; rays that others make up are left out.
/// Errors: as MakePolyhedron.
absl::StatusOr<Polyhedron> ConeOfRays(const Eigen::MatrixXd& R);

/// G x ≤ g to rounding: G x − g ≤ 64 ε (|G||x| + |g|), row by row.
bool Contains(const Polyhedron& set, const Eigen::Ref<const Eigen::VectorXd>& x);

}  // namespace metaekf::physics
