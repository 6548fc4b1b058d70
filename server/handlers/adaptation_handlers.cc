#include "server/handlers/adaptation_handlers.h"

#include "core/base/status.h"
#include "server/convert/adaptations.h"
#include "server/handlers/page.h"
#include "server/names/resource_names.h"

namespace metaekf::server {

absl::Status GetAdaptation(CallContext& context, const v1::GetAdaptationRequest& request,
                           v1::Adaptation* response) {
  METAEKF_ASSIGN_OR_RETURN(const std::string id, ParseAdaptationName("name", request.name()));
  METAEKF_ASSIGN_OR_RETURN(const store::Adaptation adaptation, context.store.adaptations().Get(id));
  *response = ToMessage(adaptation);
  return absl::OkStatus();
}

absl::Status ListAdaptations(CallContext& context,
                             const v1::ListAdaptationsRequest& request,
                             v1::ListAdaptationsResponse* response) {
  METAEKF_ASSIGN_OR_RETURN(const auto page,
                           ListPage(request, [&](const store::PageRequest& wanted) {
                             return context.store.adaptations().List(wanted);
                           }));
  for (const store::Adaptation& adaptation : page.items) {
    *response->add_adaptations() = ToMessage(adaptation);
  }
  response->set_next_page_token(page.next_page_token);
  return absl::OkStatus();
}

absl::Status DeleteAdaptation(CallContext& context,
                              const v1::DeleteAdaptationRequest& request,
                              google::protobuf::Empty*) {
  METAEKF_ASSIGN_OR_RETURN(const std::string id, ParseAdaptationName("name", request.name()));
  METAEKF_RETURN_IF_ERROR(context.store.adaptations().Delete(id));
  context.server.models.Forget(context.caller.tenant, AdaptationName(id));
  return absl::OkStatus();
}

}  // namespace metaekf::server
