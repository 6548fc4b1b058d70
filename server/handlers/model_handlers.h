#pragma once

#include <google/protobuf/empty.pb.h>

#include <memory>

#include "metaekf/v1/model.pb.h"
#include "server/handlers/call_context.h"
#include "server/handlers/stream_handler.h"

/// The RPCs of ModelService, as model.proto describes them.
namespace metaekf::server {

using google::protobuf::Empty;

absl::Status ListModels(CallContext& context, const v1::ListModelsRequest& request,
                        v1::ListModelsResponse* response);
absl::Status GetModel(CallContext& context, const v1::GetModelRequest& request,
                      v1::Model* response);
absl::Status ListModelVersions(CallContext& context,
                               const v1::ListModelVersionsRequest& request,
                               v1::ListModelVersionsResponse* response);
absl::Status GetModelVersion(CallContext& context,
                             const v1::GetModelVersionRequest& request, v1::ModelVersion* response);
absl::Status SetModelAlias(CallContext& context, const v1::SetModelAliasRequest& request,
                           v1::ModelAlias* response);
absl::Status DeleteModelAlias(CallContext& context,
                              const v1::DeleteModelAliasRequest& request, Empty* response);
absl::Status DeleteModelVersion(CallContext& context,
                                const v1::DeleteModelVersionRequest& request, Empty* response);

std::unique_ptr<StreamHandler<v1::ImportModelVersionRequest, v1::ModelVersion>> ImportModelVersion(
    CallContext context);
std::unique_ptr<ResponseSource<v1::ExportModelVersionResponse>> ExportModelVersion(
    CallContext context, const v1::ExportModelVersionRequest& request);

/// The version that a name of any of the three forms means.
absl::StatusOr<store::ModelVersion> ResolveVersion(store::ModelStore& models,
                                                   const std::string& field,
                                                   const std::string& name);

}  // namespace metaekf::server
