#pragma once

#include <vector>

#include "absl/status/statusor.h"
#include "core/data/trajectory.h"
#include "core/nssm/model.h"

namespace metaekf::meta {

/// Parameters of a Case I model that start as the linear system which explains a recording best.
///
/// A long ARX model gives the impulse response, its Hankel matrix the balanced realisation of order n_ψ (Kung's method);
/// latents are scaled to unit standard deviation on the recording. L, B and the output decoder take the realisation,
/// 𝓐 keeps the random start of `seed`.
///
/// @param normalised  in normalised units. Needs a linear bypass and linear output decoder.
/// Errors: FailedPrecondition if the recording is too short; InvalidArgument if the model has another form.
/// Source: S. Y. Kung, A new identification and model reduction algorithm via singular value decomposition, 1978.
absl::StatusOr<std::vector<double>> LinearStart(const nssm::Model& model, const data::Trajectory& normalised,
                                                uint64_t seed);

}  // namespace metaekf::meta
