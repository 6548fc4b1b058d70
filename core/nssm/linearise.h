#pragma once

#include <Eigen/Core>
#include <vector>

#include "core/nssm/model.h"

namespace metaekf::nssm {

/// First-order models of a neural state-space model, exact, in double and normalised units. These run one direction
/// at a time: right for a few evaluations, and the oracle of what is made fast elsewhere.

/// A model's step functions linearised at (x, u): Case II the state x, Case I the latent ψ.
///
///   A = ∂f/∂x,  B = ∂f/∂u,  C = ∂h/∂x,  D = ∂h/∂u
///
/// with f and h as in filter::FilterModel. Source: paper.tex eqs. jac_defs, jac_defs_vcs.
struct Linearisation {
  Eigen::VectorXd f, h;
  Eigen::MatrixXd A, B, C, D;
};

Linearisation Linearise(const Model& model, const std::vector<double>& parameters, const Eigen::VectorXd& state,
                        const Eigen::VectorXd& input);

/// How the outputs of a rollout from one start move with the parameters and with where it starts.
///
///   S = ∂ŷ/∂ω,  S₀ = ∂ŷ/∂c₀
///
/// ŷ are the rollout's outputs, step by step (n_y · length rows, as Rollout::outputs has them); c₀ its carry: ψ₀ in
/// latent mode, x₀ in state mode.
struct RolloutSensitivity {
  Eigen::VectorXd outputs;
  Eigen::MatrixXd parameters;  ///< S, one column per element of a tensor of the mask, in the order of ω
  Eigen::MatrixXd carry;       ///< S₀
};

/// @param inputs  n_u × length, as BuildRollout takes them.
RolloutSensitivity DifferentiateRollout(const Model& model, RolloutMode mode, const std::vector<double>& parameters,
                                        const nn::Mask& mask, const Eigen::VectorXd& carry,
                                        const Eigen::MatrixXd& inputs);

}  // namespace metaekf::nssm
