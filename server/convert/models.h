#pragma once

#include <string>

#include "core/nssm/bundle.h"
#include "metaekf/v1/model.pb.h"
#include "server/store/models.h"

namespace metaekf::server {

/// What a list tells of a version, for the store to keep beside its file.
/// @param training_job  jobs/{job}, or empty.
std::string VersionMetadata(const nssm::Bundle& bundle, const std::string& training_job);

v1::ModelVersion ToMessage(const store::ModelVersion& version);
v1::Model ToMessage(const store::Model& model);

}  // namespace metaekf::server
