#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <nlohmann/json_fwd.hpp>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/json_fields.h"
#include "core/data/normaliser.h"
#include "core/nn/block.h"
#include "core/physics/polyhedron.h"

namespace metaekf::nssm {

/// Case I learns from inputs and outputs, Case II from states too (paper.tex eqs. nssm_case1, nssm_case2).
enum class Case { kInputOutput, kStateInputOutput };
enum class Precision { kFloat32, kFloat64 };
enum class TransitionForm { kAutonomous, kAdditive, kJoint };
enum class Bypass { kNone, kSkip, kLinear };
enum class InputTime { kCurrent, kNext };
enum class RolloutMode { kLatent, kState };
enum class StartMode { kEncoded, kFitted };

/// ψ⁺ = bypass + 𝓐(ψ), 𝓐(ψ) + 𝓑(u) or 𝓐([ψ; u]).
struct TransitionSpec {
  nn::BlockSpec block;        // 𝓐
  nn::BlockSpec input_block;  // 𝓑
  TransitionForm form = TransitionForm::kJoint;
  Bypass bypass = Bypass::kNone;
  InputTime input_time = InputTime::kCurrent;
  double increment_scale = 1;  // γ
};

/// {x : G x ≤ g} or the cone of some rays, in physical units: the message ConstraintSpec.Polyhedron.
struct PolyhedronSpec {
  std::vector<double> matrix, bounds, rays;
  /// What stands between those units and the model's, of a model that has a normaliser; not part of the message.
  Eigen::VectorXd mean, scale;

  bool empty() const { return matrix.empty() && rays.empty(); }
};

/// The set that a specification means. @param size  n.
/// Errors: InvalidArgument if the numbers are no whole rows of n, or those of physics::MakePolyhedron.
absl::StatusOr<physics::Polyhedron> PolyhedronOf(const PolyhedronSpec& spec, int32_t size);

/// States that are angles in rad: `angle_states` of the message ModelSpec.
struct AngleSpec {
  std::vector<int32_t> states;
  /// What stands between rad and the model's units, of all states, of a model that has a normaliser; not part of the message.
  Eigen::VectorXd mean, scale;
};

/// What a model is: the message ModelSpec of spec.proto, where each field is described.
struct ModelSpec {
  static constexpr int32_t kFromData = -1;

  Case kind = Case::kInputOutput;
  int32_t input_size = kFromData;
  int32_t output_size = kFromData;
  int32_t state_size = kFromData;  ///< Case I: 0
  int32_t latent_size = 0;
  int32_t window = 10;  ///< H of Case I; 1 in Case II
  nn::BlockSpec encoder;
  TransitionSpec transition;
  nn::BlockSpec state_decoder;
  nn::BlockSpec output_decoder;
  std::vector<int32_t> curl_free_positions;  ///< not empty: 𝓟y is the gradient with respect to these states
  AngleSpec angles;
  PolyhedronSpec state_set, output_set;  ///< 𝓟x of Case II, 𝓟y; empty: none
  Precision precision = Precision::kFloat32;
  StartMode start = StartMode::kEncoded;

  bool is_case_one() const { return kind == Case::kInputOutput; }
  /// Case I without an encoder: latents come from StartFit, fits begin at a free c₀.
  bool fits_start() const { return start == StartMode::kFitted; }
  bool is_curl_free() const { return !curl_free_positions.empty(); }
  /// Samples needed before the first prediction: H in Case I, 1 in Case II.
  int32_t warmup() const { return is_case_one() ? window : 1; }
};

/// The weights and shape of a loss: the message LossSpec of spec.proto.
struct LossSpec {
  static constexpr int32_t kWholeSet = 0;

  int32_t horizon = 1;  ///< H_p; kWholeSet runs one rollout over the whole set
  RolloutMode rollout = RolloutMode::kLatent;
  int32_t stride = 1;
  double output_weight = 1;
  double state_weight = 1;
  double reconstruction_weight = 1;
};

/// Tells the constraints of a model what its normaliser is.
void TakeUnits(const data::Normaliser& normaliser, ModelSpec* spec);

/// Read the JSON forms of the messages. Errors: InvalidArgument naming the field and what is wrong with it.
absl::StatusOr<ModelSpec> ReadModelSpec(base::JsonFields fields);
absl::StatusOr<LossSpec> ReadLossSpec(base::JsonFields fields, const ModelSpec& model);

/// The inverses: every field spelled out.
nlohmann::json ToJson(const ModelSpec& spec);
nlohmann::json ToJson(const LossSpec& spec);

}  // namespace metaekf::nssm
