#include "core/physics/polyhedral_layer.h"

#include <gtest/gtest.h>

#include <cmath>

#include "core/physics/projection.h"
#include "tests/core/autodiff/derivative_check.h"

namespace metaekf::physics {
namespace {

using autodiff::Graph;
using autodiff::Value;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// A layer over a set, in units of its own.
struct Layer {
  Layer(const MatrixXd& G, const VectorXd& g, const VectorXd& given_mean, const VectorXd& given_scale)
      : set(*MakePolyhedron(G, g)), mean(given_mean), scale(given_scale), layer("constraint", set, mean, scale, &layout),
        parameters(static_cast<size_t>(layout.size())) {
    layer.Initialise(layout, parameters);
  }

  /// In physical units, of z in normalised ones.
  MatrixXd operator()(const MatrixXd& z) const {
    Graph graph;
    const nn::ParameterValues values = nn::BindParameters(layout, 0, &graph);
    const Value x = layer.Apply(&graph, values, graph.Input(1, 0, static_cast<int32_t>(z.rows()), static_cast<int32_t>(z.cols())));
    const std::vector<double> flat = autodiff::EvaluateFlat(graph, {x}, {parameters, {z.data(), z.data() + z.size()}});
    const MatrixXd normalised = Eigen::Map<const MatrixXd>(flat.data(), z.rows(), z.cols());
    return (scale.asDiagonal() * normalised).colwise() + mean;
  }

  Polyhedron set;
  VectorXd mean, scale;
  nn::ParameterLayout layout;
  PolyhedralLayer layer;
  std::vector<double> parameters;
};

MatrixXd Random(Index rows, Index cols, uint64_t seed) {
  base::Rng rng(seed);
  MatrixXd matrix(rows, cols);
  for (double& value : matrix.reshaped()) value = rng.Normal();
  return matrix;
}

/// Pressures in Pa that fall along three volumes, and a temperature.
Layer Order() {
  MatrixXd G = MatrixXd::Zero(2, 4);
  G.topLeftCorner(2, 3) << -1, 1, 0, 0, -1, 1;
  return Layer(G, VectorXd::Zero(2), Eigen::Vector4d(3e6, 2e6, 1e6, 300), Eigen::Vector4d(1e5, 2e5, 1e5, 10));
}

Layer Box() {
  MatrixXd G(4, 2);
  G << 1, 0, -1, 0, 0, 1, 0, -1;
  return Layer(G, Eigen::Vector4d(5, 1, 3, 1), Eigen::Vector2d(2, 1), Eigen::Vector2d(1, 0.5));
}

/// Bounded below, unbounded above: vertices and rays together.
Layer Wedge() {
  MatrixXd G(3, 2);
  G << -1, 0, 0, -1, -1, -1;
  return Layer(G, Eigen::Vector3d(0, 0, -1), Eigen::Vector2d(3, 4), Eigen::Vector2d(1, 1));
}

// The pressures are 5 deviations and more from each other, so that nothing holds a network back.
TEST(PolyhedralLayerTest, BeginsAsTheIdentityFarFromTheEdge) {
  const Layer order = Order();
  const MatrixXd z = Random(4, 20, 1);
  const MatrixXd physical = (order.scale.asDiagonal() * z).colwise() + order.mean;
  EXPECT_LT((order(z) - physical).cwiseQuotient(physical).cwiseAbs().maxCoeff(), 1e-12);
}

// Where a point has one set of coordinates, however close to the edge it is: here pressures fall by a hundredth of their deviations.
TEST(PolyhedralLayerTest, BeginsAsTheIdentityUpToTheEdgeOfAConeWithUniqueCoordinates) {
  MatrixXd G = MatrixXd::Zero(2, 4);
  G.topLeftCorner(2, 3) << -1, 1, 0, 0, -1, 1;
  const Layer close(G, VectorXd::Zero(2), Eigen::Vector4d(1.002e6, 1.001e6, 1e6, 300), Eigen::Vector4d(1e5, 1e5, 1e5, 10));
  MatrixXd z = 0.5 * Random(4, 20, 1);
  for (Index k = 0; k < z.cols(); ++k) z.col(k).head(3).setConstant(z(0, k));  // all three rise and fall together
  const MatrixXd physical = (close.scale.asDiagonal() * z).colwise() + close.mean;
  EXPECT_LT((close(z) - physical).cwiseQuotient(physical).cwiseAbs().maxCoeff(), 1e-12);
}

// A softmax bends away from the identity: near its middle it does not yet.
TEST(PolyhedralLayerTest, BeginsInTheMiddleOfABoxWithTheSlopeOfTheIdentity) {
  const Layer box = Box();
  const VectorXd zero = VectorXd::Zero(2);
  EXPECT_LT((box(zero) - box.mean).norm(), 1e-12);  // the middle of [−1, 5] × [−1, 3]
  const MatrixXd z = 1e-4 * Random(2, 5, 2);
  EXPECT_LT((box(z) - ((box.scale.asDiagonal() * z).colwise() + box.mean)).norm(), 1e-3 * z.norm());
}

// Weights of any size and sign; what rounding leaves outside is put inside as predictions are.
TEST(PolyhedralLayerTest, WhateverTheWeightsTheResultIsInside) {
  int corrected = 0;
  for (uint64_t seed = 0; seed < 200; ++seed) {
    for (Layer layer : {Order(), Box(), Wedge()}) {
      base::Rng rng(seed);
      const double size = std::pow(10.0, rng.Uniform(-6, 6));
      for (double& parameter : layer.parameters) parameter = size * rng.Normal();
      const MatrixXd x = layer(std::pow(10.0, rng.Uniform(-3, 3)) * Random(layer.mean.size(), 10, seed));
      for (Index k = 0; k < x.cols(); ++k) {
        const VectorXd column = x.col(k), inside = Inside(layer.set, column);
        ASSERT_TRUE(Contains(layer.set, inside)) << "seed " << seed;
        // Only rounding: of the size of what was added up.
        const double terms = layer.mean.norm() + column.norm() + size * 1e3;
        EXPECT_LT((inside - column).norm(), 1e-8 * terms * layer.scale.maxCoeff()) << "seed " << seed;
        corrected += Contains(layer.set, column) ? 0 : 1;
      }
    }
  }
  RecordProperty("corrected", corrected);
}

TEST(PolyhedralLayerTest, DerivativesPassTheConformanceSuite) {
  for (const auto& [name, make] : {std::pair<std::string, Layer (*)()>{"order", Order}, {"box", Box}, {"wedge", Wedge}}) {
    const Layer layer = make();
    std::vector<autodiff::Shape> shapes;
    for (const nn::Tensor& tensor : layer.layout.tensors()) {
      shapes.push_back(tensor.is_bias ? autodiff::Shape{tensor.out, 1} : autodiff::Shape{tensor.in, tensor.out});
    }
    shapes.push_back({static_cast<int32_t>(layer.mean.size()), 3});
    autodiff::CheckDerivatives({name, shapes,
                      [&layer](Graph* graph, const std::vector<Value>& x) {
                        const nn::ParameterValues parameters(x.begin(), x.end() - 1);
                        return layer.layer.Apply(graph, parameters, x.back());
                      }},
                     7);
  }
}

}  // namespace
}  // namespace metaekf::physics
