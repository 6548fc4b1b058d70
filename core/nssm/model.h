#pragma once

#include <optional>
#include <span>
#include <vector>

#include "absl/status/statusor.h"
#include "core/nn/block.h"
#include "core/nn/parameters.h"
#include "core/nssm/spec.h"
#include "core/physics/polyhedral_layer.h"

namespace metaekf::nssm {

/// The structure of a neural state-space model: its blocks and the layout of its parameters ω.
///
/// All values are in normalised units; data::Normaliser stands between them and the user's.
///
///   Case I    ψ_t = 𝓔(window ending at t)      ψ_{t+1} = 𝓐(ψ_t, u)      ŷ_t = 𝓟𝓓y(ψ_t)
///   Case II   ψ_t = 𝓔(x_t, u_t)    x̂_{t+1} = 𝓟x𝓓x𝓐(ψ_t, u_t)    ŷ_t = 𝓟y𝓓y(ψ_t)
///
/// Source: paper.tex eqs. nssm_case1, nssm_case2, vcc_model_for_ekf.
class Model {
 public:
  /// Errors: InvalidArgument if a size of the spec is still to be taken from data, or for a constraint (PolyhedronOf).
  static absl::StatusOr<Model> Create(const ModelSpec& spec);

  const ModelSpec& spec() const { return spec_; }
  const nn::ParameterLayout& layout() const { return layout_; }
  /// Rows of the encoder's first argument: H (n_u + n_y) in Case I, n_x in Case II.
  int32_t start_size() const;
  /// The sets that states and outputs lie in, in physical units; nullptr where they are free.
  const physics::Polyhedron* state_set() const { return state_set_ ? &*state_set_ : nullptr; }
  const physics::Polyhedron* output_set() const { return output_set_ ? &*output_set_ : nullptr; }
  /// ω₀ drawn from the seed.
  std::vector<double> InitialParameters(uint64_t seed) const;

 private:
  friend class ModelGraph;
  Model(const ModelSpec& spec, std::optional<physics::Polyhedron> state_set, std::optional<physics::Polyhedron> output_set);
  /// Rows that the encoder sees besides u: the start, and in Case II sine and cosine of its angles.
  int32_t EncodedStartSize() const;
  /// Linear 𝓔 and 𝓓x: 𝓓x starts as the pseudo-inverse of 𝓔 on x, so that a rollout through the state neither dies
  /// out nor explodes before anything is learned.
  void StartWithExactReconstruction(std::span<double> parameters) const;

  ModelSpec spec_;
  std::optional<physics::Polyhedron> state_set_, output_set_;
  nn::ParameterLayout layout_;
  nn::Block encoder_, transition_, transition_input_, state_decoder_, output_decoder_;
  size_t state_bypass_ = 0, input_bypass_ = 0;  // tensors L and B of the linear bypass
  physics::PolyhedralLayer state_constraint_, output_constraint_;
};

/// A model's parts as operations of a graph: the one definition that every derivative comes from.
class ModelGraph {
 public:
  ModelGraph(const Model* model, autodiff::Graph* graph, nn::ParameterValues parameters)
      : model_(*model), graph_(graph), parameters_(std::move(parameters)) {}

  /// ψ = 𝓔. @param start  Case I: windows, oldest sample first, each sample [u; y]; Case II: x. start_size() × b.
  /// @param input  Case II: u, n_u × b.
  autodiff::Value Encode(autodiff::Value start, autodiff::Value input) const;
  /// ψ⁺ = 𝓐(ψ, u).
  autodiff::Value Advance(autodiff::Value latent, autodiff::Value input) const;
  /// x̂ = 𝓟x𝓓x(ψ).
  autodiff::Value State(autodiff::Value latent) const;
  /// ŷ = 𝓟y𝓓y(ψ). @param state  x from which ψ was encoded; only curl-free outputs need it.
  autodiff::Value Output(autodiff::Value latent, autodiff::Value state) const;

 private:
  autodiff::Value WithAngles(autodiff::Value state) const;

  const Model& model_;
  autodiff::Graph* graph_;
  nn::ParameterValues parameters_;
};

/// Where a rollout starts from: ψ = 𝓔(start, first_input) in latent mode, x itself in state mode.
autodiff::Value StartOfRollout(const ModelGraph& parts, RolloutMode mode, autodiff::Value start,
                               autodiff::Value first_input);

/// One step of a rollout: what is carried on, and what is predicted on the way.
struct Step {
  autodiff::Value next = autodiff::kNoValue;    ///< the carry of the next step
  autodiff::Value state = autodiff::kNoValue;   ///< x̂ of the next step; Case II
  autodiff::Value output = autodiff::kNoValue;  ///< Case I: ŷ of the next step; Case II: ŷ of this one
};
Step BuildStep(const Model& model, RolloutMode mode, const ModelGraph& parts, autodiff::Value carry,
               autodiff::Value input);

/// Predictions over `length` steps from W starts at once. Columns: step by step, W columns each.
struct Rollout {
  autodiff::Value states = autodiff::kNoValue;   ///< x̂_{k+1}, k = 0 … length − 1; Case II
  autodiff::Value outputs = autodiff::kNoValue;  ///< Case I: ŷ_{k+1}; Case II: ŷ_k
  autodiff::Value carry = autodiff::kNoValue;    ///< where the next rollout would go on from, W columns
  autodiff::Value carries = autodiff::kNoValue;  ///< what each step started from
};

/// Appends a rollout to a graph.
///
/// @param carry   from StartOfRollout or the rollout before, W columns.
/// @param inputs  each step's input, n_u × length·W: u_k, in Case I with InputTime::kNext u_{k+1}; kNoValue where the
///                system has none.
Rollout BuildRollout(const Model& model, RolloutMode mode, const nn::ParameterValues& parameters,
                     autodiff::Value carry, autodiff::Value inputs, int32_t length, autodiff::Graph* graph);

}  // namespace metaekf::nssm
