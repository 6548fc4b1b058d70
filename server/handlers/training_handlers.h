#pragma once

#include <memory>

#include "metaekf/v1/training.pb.h"
#include "server/handlers/call_context.h"
#include "server/handlers/stream_handler.h"

/// The RPCs of TrainingService, as training.proto describes them; WatchJob is in watch_call.h.
namespace metaekf::server {

std::unique_ptr<StreamHandler<v1::CreateTrainingJobRequest, v1::Job>> CreateTrainingJob(
    CallContext context);
absl::Status GetJob(CallContext& context, const v1::GetJobRequest& request,
                    v1::Job* response);
absl::Status ListJobs(CallContext& context, const v1::ListJobsRequest& request,
                      v1::ListJobsResponse* response);
absl::Status CancelJob(CallContext& context, const v1::CancelJobRequest& request,
                       v1::Job* response);

}  // namespace metaekf::server
