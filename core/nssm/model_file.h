#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "core/nssm/bundle.h"

namespace metaekf::nssm {

/// Version of the metadata's layout. A file of a later version is refused, one of an earlier read or refused by name.
inline constexpr int kModelFormatVersion = 1;

/// A model as one .safetensors file: tensors named as in the layout, everything else as JSON text in the
/// metadata under "metaekf".
std::string WriteModelFile(const Bundle& bundle);

/// Errors: InvalidArgument naming the field or tensor that is missing, unknown, misshapen or not finite.
absl::StatusOr<Bundle> ReadModelFile(const std::string& bytes);

/// The tensors of `mask` alone, as a .safetensors file: what an adaptation stores beside its base version. A posterior goes
/// with them, as "posterior.information": the lower triangle, row by row. One of few coordinates says all by itself:
/// "posterior.coordinates" stands for the tensors then, whose names are in the metadata. Q and R of the adapted model are
/// "noise.process" and "noise.measurement".
std::string WriteAdaptedSubset(const Bundle& bundle, const nn::Mask& mask);

/// Puts an adapted subset over the parameters of its base.
/// Errors: InvalidArgument naming the tensor that is unknown, misshapen or not finite.
absl::Status ApplyAdaptedSubset(const std::string& bytes, Bundle* bundle);

}  // namespace metaekf::nssm
