#include "server/handlers/model_handlers.h"

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "server/convert/models.h"
#include "server/handlers/page.h"
#include "server/names/resource_names.h"

namespace metaekf::server {

absl::Status ListModels(CallContext& context, const v1::ListModelsRequest& request,
                        v1::ListModelsResponse* response) {
  METAEKF_ASSIGN_OR_RETURN(const auto page,
                           ListPage(request, [&](const store::PageRequest& wanted) {
                             return context.store.models().List(wanted);
                           }));
  for (const store::Model& model : page.items) *response->add_models() = ToMessage(model);
  response->set_next_page_token(page.next_page_token);
  return absl::OkStatus();
}

absl::Status GetModel(CallContext& context, const v1::GetModelRequest& request,
                      v1::Model* response) {
  METAEKF_ASSIGN_OR_RETURN(const std::string name, ParseModelName("name", request.name()));
  METAEKF_ASSIGN_OR_RETURN(const store::Model model, context.store.models().Get(name));
  *response = ToMessage(model);
  return absl::OkStatus();
}

absl::Status ListModelVersions(CallContext& context,
                               const v1::ListModelVersionsRequest& request,
                               v1::ListModelVersionsResponse* response) {
  METAEKF_ASSIGN_OR_RETURN(const std::string model, ParseModelName("parent", request.parent()));
  METAEKF_ASSIGN_OR_RETURN(const auto page,
                           ListPage(request, [&](const store::PageRequest& wanted) {
                             return context.store.models().ListVersions(model, wanted);
                           }));
  for (const store::ModelVersion& version : page.items) {
    *response->add_model_versions() = ToMessage(version);
  }
  response->set_next_page_token(page.next_page_token);
  return absl::OkStatus();
}

absl::Status GetModelVersion(CallContext& context,
                             const v1::GetModelVersionRequest& request,
                             v1::ModelVersion* response) {
  METAEKF_ASSIGN_OR_RETURN(const store::ModelVersion version,
                           ResolveVersion(context.store.models(), "name", request.name()));
  *response = ToMessage(version);
  return absl::OkStatus();
}

absl::Status SetModelAlias(CallContext& context, const v1::SetModelAliasRequest& request,
                           v1::ModelAlias* response) {
  METAEKF_ASSIGN_OR_RETURN(const Target target,
                           ParseAliasName("alias.name", request.alias().name()));
  METAEKF_RETURN_IF_ERROR(context.store.models().SetAlias(target.model, target.alias,
                                                          int64_t{request.alias().version()}));
  *response = request.alias();
  return absl::OkStatus();
}

absl::Status DeleteModelAlias(CallContext& context,
                              const v1::DeleteModelAliasRequest& request, Empty*) {
  METAEKF_ASSIGN_OR_RETURN(const Target target, ParseAliasName("name", request.name()));
  return context.store.models().DeleteAlias(target.model, target.alias);
}

absl::Status DeleteModelVersion(CallContext& context,
                                const v1::DeleteModelVersionRequest& request, Empty*) {
  METAEKF_ASSIGN_OR_RETURN(const Target target, ParseVersionName("name", request.name()));
  METAEKF_RETURN_IF_ERROR(context.store.models().DeleteVersion(target.model, target.version));
  context.server.models.Forget(context.caller.tenant, VersionName(target.model, target.version));
  return absl::OkStatus();
}

absl::StatusOr<store::ModelVersion> ResolveVersion(store::ModelStore& models,
                                                   const std::string& field,
                                                   const std::string& name) {
  METAEKF_ASSIGN_OR_RETURN(const Target target, ParseModelTarget(field, name));
  return ResolveTarget(models, target);
}

}  // namespace metaekf::server
