#include "core/physics/polyhedral_layer.h"

#include <algorithm>
#include <vector>

#include "core/linalg/decompositions.h"

namespace metaekf::physics {

using autodiff::Activation;
using autodiff::Graph;
using autodiff::Value;
using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

constexpr double kAwake = 0.5;  // what a ray's coordinate begins with at least, for its ReLU to have a slope
constexpr double kUnique = 1e-8;

std::vector<double> Elements(const MatrixXd& matrix) { return {matrix.data(), matrix.data() + matrix.size()}; }

Value Constant(Graph* graph, const MatrixXd& matrix) {
  return graph->ConstantData(Elements(matrix), static_cast<int32_t>(matrix.rows()), static_cast<int32_t>(matrix.cols()));
}

/// Puts rows `from` … of C⁺ and of what C⁺ gives for a vector into a part's tensors.
void Write(const nn::ParameterLayout& layout, size_t weight, size_t bias, const MatrixXd& inverse, const VectorXd& at_zero,
           Index from, std::span<double> parameters) {
  const nn::Tensor& w = layout.tensors()[weight];
  for (Index i = 0; i < w.out; ++i) {
    for (Index j = 0; j < w.in; ++j) parameters[static_cast<size_t>(w.offset + i * w.in + j)] = inverse(from + i, j);
    parameters[static_cast<size_t>(layout.tensors()[bias].offset + i)] = at_zero[from + i];
  }
}

}  // namespace

PolyhedralLayer::PolyhedralLayer(const std::string& name, const Polyhedron& set, const VectorXd& mean, const VectorXd& scale,
                                 nn::ParameterLayout* layout) {
  const VectorXd inverse = scale.cwiseInverse();
  MatrixXd rays = inverse.asDiagonal() * set.rays, free = inverse.asDiagonal() * set.lineality;
  for (Index k = 0; k < rays.cols(); ++k) rays.col(k) /= rays.col(k).cwiseAbs().maxCoeff();
  if (free.cols() > 0) free = linalg::DecomposeSingularValues(free).u;
  AddPart(name + ".rays", rays, layout, &rays_);
  AddPart(name + ".vertices", inverse.asDiagonal() * (set.vertices.colwise() - mean), layout, &vertices_);
  AddPart(name + ".free", free, layout, &free_);
  offset_ = set.vertices.cols() > 0 ? VectorXd::Zero(mean.size()) : VectorXd(-mean.cwiseProduct(inverse));
}

void PolyhedralLayer::AddPart(const std::string& name, MatrixXd generators, nn::ParameterLayout* layout, Part* part) {
  const int32_t n = static_cast<int32_t>(generators.rows()), k = static_cast<int32_t>(generators.cols());
  part->generators = std::move(generators);
  if (k == 0) return;
  part->weight = layout->Add(name + ".weight", k, n);
  part->bias = layout->Add(name + ".bias", k, 1, true);
}

Value PolyhedralLayer::Apply(Graph* graph, const nn::ParameterValues& parameters, Value decoded) const {
  Value sum = autodiff::kNoValue;
  const auto add = [&](const Part& part, const auto& shape) {
    if (part.generators.cols() == 0) return;
    const Value coordinates = graph->AddColumn(graph->MatMul(parameters[part.weight], decoded, true), parameters[part.bias]);
    sum = graph->AddOrEither(sum, graph->MatMul(Constant(graph, part.generators), shape(coordinates)));
  };
  add(rays_, [graph](Value c) { return graph->Apply(Activation::kRelu, 0, 0, c); });
  add(vertices_, [graph](Value c) { return graph->Softmax(c); });
  add(free_, [](Value c) { return c; });
  const Value offset = Constant(graph, offset_);
  if (sum == autodiff::kNoValue) return graph->Tile(offset, 1, graph->node(decoded).cols);
  return graph->AddColumn(sum, offset);
}

void PolyhedralLayer::Initialise(const nn::ParameterLayout& layout, std::span<double> parameters) const {
  // Around equal shares of all vertices a softmax moves them by (λ − mean of λ)/v, so x̃ = middle + C [rays; vertices; free].
  const Index r = rays_.generators.cols(), v = vertices_.generators.cols(), l = free_.generators.cols(), n = offset_.size();
  VectorXd middle = offset_;
  MatrixXd vertices = vertices_.generators;
  if (v > 0) {
    middle += vertices.rowwise().mean();
    vertices = (vertices.colwise() - VectorXd(vertices.rowwise().mean())) / static_cast<double>(v);
  }
  MatrixXd all(n, r + v + l);
  all << rays_.generators, vertices, free_.generators;
  const MatrixXd inverse = linalg::SolveLeastSquares(all, MatrixXd::Identity(n, n));
  VectorXd at_zero = inverse * -middle;
  // Of independent generators a point of the set has one set of coordinates, none of them below zero. Else what the inverse gives may be.
  const bool unique = v == 0 && (inverse * all - MatrixXd::Identity(r + l, r + l)).cwiseAbs().maxCoeff() < kUnique;
  if (!unique) at_zero.head(r) = at_zero.head(r).cwiseMax(kAwake);
  if (r > 0) Write(layout, rays_.weight, rays_.bias, inverse, at_zero, 0, parameters);
  if (v > 0) Write(layout, vertices_.weight, vertices_.bias, inverse, at_zero, r, parameters);
  if (l > 0) Write(layout, free_.weight, free_.bias, inverse, at_zero, r + v, parameters);
}

}  // namespace metaekf::physics
