// Rays and vertices against those of cddlib, an implementation of the double description method that is not ours.
#include <gtest/gtest.h>

#include <cddlib/setoper.h>
#include <cddlib/cdd.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "core/base/rng.h"
#include "core/physics/polyhedron.h"

namespace metaekf::physics {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

struct Generators {
  std::vector<VectorXd> rays, vertices;
  int free = 0;
};

/// The same vectors, in any order, to the digits that both programs have.
bool Same(const std::vector<VectorXd>& a, const std::vector<VectorXd>& b) {
  if (a.size() != b.size()) return false;
  return std::all_of(a.begin(), a.end(), [&b](const VectorXd& x) {
    return std::any_of(b.begin(), b.end(), [&x](const VectorXd& y) { return (x - y).norm() <= 1e-7 * (1 + x.norm()); });
  });
}

Generators OfCdd(const MatrixXd& G, const VectorXd& g) {
  dd_MatrixPtr inequalities = dd_CreateMatrix(G.rows(), G.cols() + 1);  // [g −G]: g − G x ≥ 0
  inequalities->representation = dd_Inequality;
  inequalities->numbtype = dd_Real;
  for (Index i = 0; i < G.rows(); ++i) {
    dd_set_d(inequalities->matrix[i][0], g[i]);
    for (Index j = 0; j < G.cols(); ++j) dd_set_d(inequalities->matrix[i][j + 1], -G(i, j));
  }
  dd_ErrorType error = dd_NoError;
  dd_PolyhedraPtr set = dd_DDMatrix2Poly(inequalities, &error);
  EXPECT_EQ(error, dd_NoError);
  dd_MatrixPtr found = dd_CopyGenerators(set);
  Generators result;
  for (long i = 0; i < found->rowsize; ++i) {
    VectorXd x(G.cols());
    for (Index j = 0; j < G.cols(); ++j) x[j] = dd_get_d(found->matrix[i][j + 1]);
    if (set_member(i + 1, found->linset)) {
      ++result.free;
    } else if (dd_get_d(found->matrix[i][0]) > 0.5) {  // 1 of a vertex, 0 but for rounding of a ray
      result.vertices.push_back(x);
    } else {
      result.rays.push_back(x / x.cwiseAbs().maxCoeff());
    }
  }
  dd_FreeMatrix(found);
  dd_FreePolyhedra(set);
  dd_FreeMatrix(inequalities);
  return result;
}

Generators OfOurs(const Polyhedron& set) {
  Generators result{.free = static_cast<int>(set.lineality.cols())};
  for (Index k = 0; k < set.rays.cols(); ++k) result.rays.push_back(set.rays.col(k));
  for (Index k = 0; k < set.vertices.cols(); ++k) result.vertices.push_back(set.vertices.col(k));
  if (result.vertices.empty()) result.vertices.push_back(VectorXd::Zero(set.dimension()));  // a cone's
  return result;
}

TEST(PolyhedronCddTest, RandomSetsAreMadeOfTheSame) {
  dd_set_global_constants();
  int compared = 0, with_free_directions = 0;
  for (uint64_t seed = 0; seed < 300; ++seed) {
    base::Rng rng(seed);
    const Index n = 2 + static_cast<Index>(seed % 5), m = n - 1 + static_cast<Index>(seed % 9);
    MatrixXd G(m, n);
    VectorXd g(m);
    for (double& value : G.reshaped()) value = std::round(3 * rng.Normal());
    for (double& value : g) value = seed % 2 == 0 ? 0 : std::round(5 * std::fabs(rng.Normal()));
    const absl::StatusOr<Polyhedron> set = MakePolyhedron(G, g);
    ASSERT_TRUE(set.ok()) << set.status();  // 0 is in it
    const Generators ours = OfOurs(*set);
    Generators theirs = OfCdd(G, g);
    if (theirs.vertices.empty()) theirs.vertices.push_back(VectorXd::Zero(n));
    EXPECT_EQ(ours.free, theirs.free) << "seed " << seed;
    if (ours.free > 0) {  // rays may lean on those directions, and so differ
      EXPECT_EQ(ours.rays.size(), theirs.rays.size()) << "seed " << seed;
      ++with_free_directions;
      continue;
    }
    EXPECT_TRUE(Same(ours.rays, theirs.rays) && Same(ours.vertices, theirs.vertices)) << "seed " << seed << "\n" << G << "\n\n" << g;
    ++compared;
  }
  EXPECT_GT(compared, 100);
  EXPECT_GT(with_free_directions, 10);
  dd_free_global_constants();
}

}  // namespace
}  // namespace metaekf::physics
