#include "core/physics/polyhedron.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/numbers.h"
#include "core/base/status.h"
#include "core/linalg/decompositions.h"

namespace metaekf::physics {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kZero = 1e-9;          // of products of unit vectors: rays that lie in a constraint's plane
constexpr double kRank = 1e-10;         // of the largest singular value
constexpr double kClean = 1e-12;        // elements of rays below it are zero
constexpr size_t kMostRays = 1024;  // a row takes a second then, and a specification may come from a stranger

/// A set of constraints.
class Bits {
 public:
  explicit Bits(Index size) : words_(static_cast<size_t>((size + 63) / 64)) {}

  void Set(Index i) { words_[static_cast<size_t>(i / 64)] |= uint64_t{1} << (i % 64); }
  int Count() const {
    int count = 0;
    for (const uint64_t word : words_) count += __builtin_popcountll(word);
    return count;
  }
  bool Has(Index i) const { return (words_[static_cast<size_t>(i / 64)] >> (i % 64) & 1) != 0; }
  bool Includes(const Bits& other) const {
    for (size_t i = 0; i < words_.size(); ++i) {
      if ((other.words_[i] & ~words_[i]) != 0) return false;
    }
    return true;
  }
  friend Bits operator&(Bits a, const Bits& b) {
    for (size_t i = 0; i < a.words_.size(); ++i) a.words_[i] &= b.words_[i];
    return a;
  }

 private:
  std::vector<uint64_t> words_;
};

/// A ray and the constraints whose planes it lies in.
struct Ray {
  VectorXd direction;
  Bits active;
};

/// Orthonormal bases of the row space of A and of its kernel.
struct Subspaces {
  MatrixXd row_space, kernel;
};

Subspaces Split(const MatrixXd& a) {
  const Index n = a.cols();
  MatrixXd padded = MatrixXd::Zero(std::max(a.rows(), n), n);
  padded.topRows(a.rows()) = a;
  const linalg::SingularValues svd = linalg::DecomposeSingularValues(padded);
  const Index rank = (svd.values.array() > kRank * std::max(svd.values.maxCoeff(), std::numeric_limits<double>::min())).count();
  return {svd.v.leftCols(rank), svd.v.rightCols(n - rank)};
}

/// Rows of A, as many as it has columns, that are linearly independent: each the one that is farthest from those before it.
std::vector<Index> IndependentRows(const MatrixXd& a) {
  MatrixXd rest = a;
  std::vector<Index> chosen;
  for (Index k = 0; k < a.cols(); ++k) {
    Index farthest = 0;
    rest.rowwise().norm().maxCoeff(&farthest);
    chosen.push_back(farthest);
    const VectorXd direction = rest.row(farthest).transpose().normalized();
    rest -= (rest * direction) * direction.transpose();
    rest.row(farthest).setZero();
  }
  return chosen;
}

/// Whether an edge of the cone joins two rays: no third one lies in all the planes that they share.
bool Adjacent(const std::vector<Ray>& rays, size_t a, size_t b, Index dimension) {
  const Bits shared = rays[a].active & rays[b].active;
  if (shared.Count() < dimension - 2) return false;
  for (size_t k = 0; k < rays.size(); ++k) {
    if (k != a && k != b && rays[k].active.Includes(shared)) return false;
  }
  return true;
}

/// Cuts off what violates constraint i, a · w ≤ 0. Errors: InvalidArgument if there are too many rays.
absl::Status Cut(const VectorXd& a, Index i, std::vector<Ray>* rays) {
  std::vector<double> values;
  for (const Ray& ray : *rays) {
    const double value = a.dot(ray.direction);
    values.push_back(std::fabs(value) <= kZero ? 0 : value);
  }
  std::vector<Ray> next;
  for (size_t p = 0; p < rays->size(); ++p) {
    if (!(values[p] > 0)) continue;
    for (size_t q = 0; q < rays->size(); ++q) {
      if (!(values[q] < 0) || !Adjacent(*rays, p, q, a.size())) continue;
      Ray ray{(values[p] * (*rays)[q].direction - values[q] * (*rays)[p].direction).normalized(),
              (*rays)[p].active & (*rays)[q].active};
      ray.active.Set(i);
      next.push_back(std::move(ray));
    }
  }
  for (size_t k = 0; k < rays->size(); ++k) {
    if (values[k] > 0) continue;
    if (values[k] == 0) (*rays)[k].active.Set(i);
    next.push_back(std::move((*rays)[k]));
  }
  if (next.size() > kMostRays) {
    return absl::InvalidArgumentError(absl::StrCat("the set has more than ", kMostRays, " rays after its row ", i + 1));
  }
  *rays = std::move(next);
  return absl::OkStatus();
}

/// The direction that all planes of a ray have in common, to the last digits.
VectorXd Polished(const MatrixXd& a, const Ray& ray) {
  std::vector<Index> active;
  for (Index i = 0; i < a.rows(); ++i) {
    if (ray.active.Has(i)) active.push_back(i);
  }
  const Subspaces subspaces = Split(a(active, Eigen::all));
  if (subspaces.kernel.cols() != 1) return ray.direction;
  const VectorXd direction = subspaces.kernel.col(0);
  return direction.dot(ray.direction) < 0 ? VectorXd(-direction) : direction;
}

/// The extreme rays of {w : A w ≤ 0}, one a column. @param a  rows of unit length, of full column rank.
absl::StatusOr<MatrixXd> ExtremeRays(const MatrixXd& a) {
  const Index d = a.cols();
  if (d == 0) return MatrixXd(0, 0);
  const std::vector<Index> first = IndependentRows(a);
  // A w = −e_k: each ray of the first, simplicial cone leaves one plane.
  const MatrixXd simplex = linalg::SolveLeastSquares(a(first, Eigen::all), -MatrixXd::Identity(d, d));
  std::vector<Ray> rays;
  for (Index k = 0; k < d; ++k) {
    Ray ray{simplex.col(k).normalized(), Bits(a.rows())};
    for (Index j = 0; j < d; ++j) {
      if (j != k) ray.active.Set(first[static_cast<size_t>(j)]);
    }
    rays.push_back(std::move(ray));
  }
  for (Index i = 0; i < a.rows(); ++i) {
    if (std::find(first.begin(), first.end(), i) != first.end()) continue;
    METAEKF_RETURN_IF_ERROR(Cut(a.row(i).transpose(), i, &rays));
  }
  MatrixXd result(d, static_cast<Index>(rays.size()));
  for (size_t k = 0; k < rays.size(); ++k) result.col(static_cast<Index>(k)) = Polished(a, rays[k]);
  return result;
}

/// [G −g; 0 −1] with rows of unit length, those that are zero left out.
MatrixXd Homogenised(const MatrixXd& G, const VectorXd& g) {
  MatrixXd all(G.rows() + 1, G.cols() + 1);
  all << G, -g, Eigen::RowVectorXd::Zero(G.cols()), -1;
  std::vector<Index> kept;
  for (Index i = 0; i < all.rows(); ++i) {
    const double length = all.row(i).norm();
    if (length == 0) continue;
    all.row(i) /= length;
    kept.push_back(i);
  }
  return all(kept, Eigen::all);
}

VectorXd Clean(VectorXd v) {
  for (double& element : v) {
    if (std::fabs(element) < kClean * v.cwiseAbs().maxCoeff()) element = 0;
  }
  return v;
}

MatrixXd ToMatrix(const std::vector<VectorXd>& columns, Index rows) {
  MatrixXd matrix(rows, static_cast<Index>(columns.size()));
  for (size_t k = 0; k < columns.size(); ++k) matrix.col(static_cast<Index>(k)) = columns[k];
  return matrix;
}

/// Rays, vertices and lineality; no vertex where the set is empty.
absl::StatusOr<Polyhedron> Generate(const MatrixXd& G, const VectorXd& g) {
  const Index n = G.cols();
  const MatrixXd homogenised = Homogenised(G, g);
  const Subspaces subspaces = Split(homogenised);
  MatrixXd reduced = homogenised * subspaces.row_space;
  reduced.rowwise().normalize();
  METAEKF_ASSIGN_OR_RETURN(const MatrixXd extreme, ExtremeRays(reduced));
  std::vector<VectorXd> rays, vertices;
  for (Index k = 0; k < extreme.cols(); ++k) {
    const VectorXd point = subspaces.row_space * extreme.col(k);
    const double t = point[n];
    if (t > kZero) {
      vertices.push_back(Clean(point.head(n) / t));
    } else {
      rays.push_back(Clean(point.head(n) / point.head(n).cwiseAbs().maxCoeff()));
    }
  }
  return Polyhedron{.G = G, .g = g, .rays = ToMatrix(rays, n), .vertices = ToMatrix(vertices, n),
                    .lineality = subspaces.kernel.topRows(n)};
}

}  // namespace

absl::StatusOr<Polyhedron> MakePolyhedron(const MatrixXd& G, const VectorXd& g) {
  if (g.size() != G.rows()) {
    return absl::InvalidArgumentError(absl::StrCat("G has ", G.rows(), " rows, g has ", g.size(), " elements"));
  }
  for (Index i = 0; i < G.rows(); ++i) {
    if (!G.row(i).allFinite() || !std::isfinite(g[i])) {
      return absl::InvalidArgumentError(absl::StrCat("row ", i + 1, " of the constraint has an element that is not finite"));
    }
  }
  METAEKF_ASSIGN_OR_RETURN(Polyhedron set, Generate(G, g));
  if (set.vertices.cols() == 0) {
    const auto leaves_something = [&](Index rows) {
      const absl::StatusOr<Polyhedron> part = Generate(G.topRows(rows), g.head(rows));
      return !part.ok() || part->vertices.cols() > 0;  // what has too many rays is not empty
    };
    Index rows = 1;
    while (rows < G.rows() && leaves_something(rows)) ++rows;
    return absl::InvalidArgumentError(absl::StrCat("the constraint leaves nothing: its row ", rows,
                                                   " excludes all that the rows before it allow"));
  }
  if ((g.array() == 0).all()) set.vertices.resize(G.cols(), 0);  // a cone's is 0
  return set;
}

absl::StatusOr<Polyhedron> ConeOfRays(const MatrixXd& R) {
  if (!R.allFinite()) return absl::InvalidArgumentError("the rays have an element that is not finite");
  // a · x ≤ 0 for all x of the cone: the a are a cone themselves, and what it is made of is the least that says so.
  METAEKF_ASSIGN_OR_RETURN(const Polyhedron polar, MakePolyhedron(R.transpose(), VectorXd::Zero(R.cols())));
  MatrixXd G(polar.rays.cols() + 2 * polar.lineality.cols(), R.rows());
  G << polar.rays.transpose(), polar.lineality.transpose(), -polar.lineality.transpose();
  return MakePolyhedron(G, VectorXd::Zero(G.rows()));
}

bool Contains(const Polyhedron& set, const Eigen::Ref<const VectorXd>& x) {
  constexpr double kRounding = 64 * std::numeric_limits<double>::epsilon();
  for (Index i = 0; i < set.G.rows(); ++i) {
    double value = -set.g[i], size = std::fabs(set.g[i]);
    for (Index j = 0; j < x.size(); ++j) {
      value += set.G(i, j) * x[j];
      size += std::fabs(set.G(i, j) * x[j]);
    }
    if (!(value <= kRounding * size)) return false;
  }
  return true;
}

}  // namespace metaekf::physics
