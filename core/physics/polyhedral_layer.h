#pragma once

#include <Eigen/Core>
#include <span>
#include <string>

#include "core/nn/parameters.h"
#include "core/physics/polyhedron.h"

namespace metaekf::physics {

/// Keeps what a network says inside a polyhedron, 𝓟 of paper.tex eq. constr_structure_vccs:
///
///   x = R ReLU(W_r z + b_r) + V softmax(W_v z + b_v) + L (W_l z + b_l)
///
/// with z what was decoded, and R, V, L the set's rays, vertices and free directions. In the network's normalised units,
/// x = mean + scale ∘ x̃, R and L are scaled to be of the order of one. W and b are trained, the set is not.
///
/// It begins close to the identity, x̃ = z, where the set lets it: then a constrained model is as easy to train as a free one.
class PolyhedralLayer {
 public:
  PolyhedralLayer() = default;
  /// Appends `name`.rays.weight, .rays.bias, .vertices.…, .free.… to the layout, those of them that the set has.
  /// @param mean, scale  n each, of the physical quantities; scales positive.
  PolyhedralLayer(const std::string& name, const Polyhedron& set, const Eigen::VectorXd& mean, const Eigen::VectorXd& scale,
                  nn::ParameterLayout* layout);

  /// @param decoded  z, n × b, in normalised units. @return x̃, n × b.
  autodiff::Value Apply(autodiff::Graph* graph, const nn::ParameterValues& parameters, autodiff::Value decoded) const;

  void Initialise(const nn::ParameterLayout& layout, std::span<double> parameters) const;

 private:
  /// One kind of generators and the tensors of its coordinates.
  struct Part {
    Eigen::MatrixXd generators;  // n × k, normalised
    size_t weight = 0, bias = 0;
  };
  static void AddPart(const std::string& name, Eigen::MatrixXd generators, nn::ParameterLayout* layout, Part* part);

  Part rays_, vertices_, free_;
  Eigen::VectorXd offset_;  // of a set without vertices: where it has its apex
};

}  // namespace metaekf::physics
