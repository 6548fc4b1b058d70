#include "server/handlers/training_handlers.h"

#include "core/base/status.h"
#include "server/convert/jobs.h"
#include "server/handlers/page.h"
#include "server/names/resource_names.h"

namespace metaekf::server {

absl::Status GetJob(CallContext& context, const v1::GetJobRequest& request,
                    v1::Job* response) {
  METAEKF_ASSIGN_OR_RETURN(const int64_t number, ParseJobName("name", request.name()));
  METAEKF_ASSIGN_OR_RETURN(const store::Job job, context.store.jobs().Get(number));
  *response = ToMessage(job);
  return absl::OkStatus();
}

absl::Status ListJobs(CallContext& context, const v1::ListJobsRequest& request,
                      v1::ListJobsResponse* response) {
  METAEKF_ASSIGN_OR_RETURN(const auto page,
                           ListPage(request, [&](const store::PageRequest& wanted) {
                             return context.store.jobs().List(wanted);
                           }));
  for (const store::Job& job : page.items) *response->add_jobs() = ToMessage(job);
  response->set_next_page_token(page.next_page_token);
  return absl::OkStatus();
}

absl::Status CancelJob(CallContext& context, const v1::CancelJobRequest& request,
                       v1::Job* response) {
  METAEKF_ASSIGN_OR_RETURN(const int64_t number, ParseJobName("name", request.name()));
  METAEKF_ASSIGN_OR_RETURN(const store::Job job, context.store.jobs().Cancel(number));
  context.server.training.CheckJobs();
  context.server.jobs.Notify({context.caller.tenant, number});
  *response = ToMessage(job);
  return absl::OkStatus();
}

}  // namespace metaekf::server
