#pragma once

#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/data/trajectory.h"
#include "core/nssm/model.h"

namespace metaekf::meta {

/// Whether a model can begin with LinearStateStart: Case II, a linear bypass, encoder and state decoder of one layer, at least as
/// many latents as the encoder has inputs. Errors: InvalidArgument saying what is in the way.
absl::Status CheckLinearStateStart(const nssm::ModelSpec& spec);

/// Parameters of a Case II model that start as the linear system which explains a fleet best, in its principal coordinates.
///
/// With v_t = [x; sin, cos of angles; u] of second moments C = V Λ Vᵀ over the fleet:
///
///   encoder  ψ = E v,  E = (Λ + ε I)^−½ Vᵀ        decoder  x̃ = [I 0] E⁻¹ ψ
///   linear bypass  L = E [M; 0 I] E⁻¹,  M = argmin Σ ‖x_{t+1} − M v_t‖² + ρ N ‖M‖²        output decoder  the same of y_t
///
/// States that nearly follow from each other, as pressures along a pipe do, are what gradient descent on v itself learns last; in
/// ψ it sees them as it sees the others. ε (a tenth of a deviation) keeps the network from making much of what is hardly ever
/// seen, ρ (a hundredth) is what M would be of states that were known no better. An output decoder that is no single layer keeps
/// its random start, and so does 𝓐, but for its last layer, which is a hundredth of it.
///
/// @param fleet  in normalised units, with states. @param seed  of the random start.
/// Errors: those of CheckLinearStateStart.
absl::StatusOr<std::vector<double>> LinearStateStart(const nssm::Model& model, const std::vector<data::Trajectory>& fleet, uint64_t seed);

}  // namespace metaekf::meta
