#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "core/meta/adapt.h"
#include "metaekf/v1/adaptation.pb.h"
#include "server/store/adaptations.h"

namespace metaekf::server {

/// The model's own way to adapt, with what the request overrides.
/// Errors: InvalidArgument with a violation below "options"; FailedPrecondition if the model does
/// not say how it was trained.
absl::StatusOr<meta::AdaptationOptions> ResolveOptions(const v1::AdaptRequest::Options& request,
                                                       const nssm::Bundle& bundle);

/// How an adaptation was made and what it gained, for the store to keep beside its file.
std::string AdaptationReceipt(const meta::AdaptationOptions& options,
                              const meta::AdaptationResult& result, double duration_s);

v1::Adaptation ToMessage(const store::Adaptation& adaptation);

}  // namespace metaekf::server
