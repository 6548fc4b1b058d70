#include "server/convert/jobs.h"

#include "server/convert/json.h"
#include "server/convert/time.h"
#include "server/names/resource_names.h"

namespace metaekf::server {
namespace {

v1::Job::State ToMessage(store::JobState state) {
  switch (state) {
    case store::JobState::kQueued:
      return v1::Job::QUEUED;
    case store::JobState::kRunning:
      return v1::Job::RUNNING;
    case store::JobState::kSucceeded:
      return v1::Job::SUCCEEDED;
    case store::JobState::kFailed:
      return v1::Job::FAILED;
    case store::JobState::kCancelled:
      return v1::Job::CANCELLED;
  }
  return v1::Job::STATE_UNSPECIFIED;
}

}  // namespace

v1::Job ToMessage(const store::Job& job) {
  v1::Job message;
  message.set_name(JobName(job.number));
  message.set_model(ModelName(job.model));
  // Both were written by this server or its worker; what cannot be read is left out.
  JsonToMessage(job.spec_json, message.mutable_spec()).IgnoreError();
  if (!job.progress_json.empty()) {
    JsonToMessage(job.progress_json, message.mutable_progress()).IgnoreError();
  }
  message.set_state(ToMessage(job.state));
  message.set_error_message(job.error);
  if (job.result_version > 0) {
    message.set_model_version(VersionName(job.model, job.result_version));
  }
  message.set_attempt(static_cast<uint32_t>(job.attempt));
  *message.mutable_create_time() = ToTimestamp(job.create_time);
  if (job.start_time > absl::UnixEpoch()) {
    *message.mutable_start_time() = ToTimestamp(job.start_time);
  }
  if (job.end_time > absl::UnixEpoch()) *message.mutable_end_time() = ToTimestamp(job.end_time);
  return message;
}

v1::WatchJobResponse ToWatchResponse(const store::Job& job) {
  v1::Job message = ToMessage(job);
  v1::WatchJobResponse response;
  response.set_state(message.state());
  if (message.has_progress()) response.mutable_progress()->Swap(message.mutable_progress());
  response.set_error_message(message.error_message());
  response.set_model_version(message.model_version());
  return response;
}

}  // namespace metaekf::server
