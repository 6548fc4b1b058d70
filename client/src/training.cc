#include "client/src/impl.h"
#include "client/src/text_proto.h"

namespace metaekf::client {
namespace {

using v1::TrainingService;

void Update(const v1::WatchJobResponse& response, Job& job) {
  job.state = FromProto(response.state());
  if (response.has_progress()) job.progress = FromProto(response.progress());
  job.error_message = response.error_message();
  if (!response.model_version().empty()) job.model_version = VersionOf(response.model_version());
}

}  // namespace

Result<Job> Client::CreateTrainingJob(const TrainingRequest& request) {
  v1::CreateTrainingJobRequest message;
  auto* header = message.mutable_header();
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*header->mutable_model(), BareModelResource(request.model));
  METAEKF_CLIENT_RETURN_IF_ERROR(
      ParseText(request.spec, request.spec_source, header->mutable_spec()));
  ToProto(request.channels, header->mutable_channels());
  header->set_request_id(request.request_id);

  impl_->Connect();
  grpc::ClientContext context;
  impl_->Authorise(context);
  v1::Job response;
  const auto stream = impl_->training->CreateTrainingJob(&context, &response);
  bool open = stream->Write(message);
  for (size_t i = 0; open && i < request.fleet.size(); ++i) {
    const Status sent = SendSamples(request.fleet[i], [&](v1::Samples samples) {
      *message.mutable_samples() = std::move(samples);
      return open = stream->Write(message);
    });
    if (!sent.ok()) {
      context.TryCancel();
      stream->Finish();
      return sent;
    }
  }
  stream->WritesDone();
  METAEKF_CLIENT_RETURN_IF_ERROR(impl_->Translate(stream->Finish()));
  return FromProto(response);
}

Result<Job> Client::GetJob(const std::string& id) {
  v1::GetJobRequest request;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*request.mutable_name(), Resource("jobs", id));
  v1::Job response;
  METAEKF_CLIENT_RETURN_IF_ERROR(impl_->Call(impl_->training, &TrainingService::Stub::GetJob, request, &response));
  return FromProto(response);
}

Result<std::vector<Job>> Client::ListJobs() {
  return impl_->List<Job>(impl_->training, &TrainingService::Stub::ListJobs, v1::ListJobsRequest(),
                          &v1::ListJobsResponse::jobs);
}

Result<Job> Client::WatchJob(const std::string& id,
                             const std::function<bool(const Job&)>& on_change) {
  METAEKF_CLIENT_ASSIGN_OR_RETURN(Job job, GetJob(id));
  v1::WatchJobRequest request;
  request.set_name("jobs/" + job.id);
  impl_->Connect();
  grpc::ClientContext context;
  impl_->Authorise(context);
  const auto stream = impl_->training->WatchJob(&context, request);
  v1::WatchJobResponse response;
  bool wanted = true;
  while (wanted && stream->Read(&response)) {
    Update(response, job);
    wanted = on_change(job);
  }
  if (!wanted) context.TryCancel();
  const grpc::Status status = stream->Finish();
  if (wanted) METAEKF_CLIENT_RETURN_IF_ERROR(impl_->Translate(status));
  return GetJob(id);
}

Result<Job> Client::CancelJob(const std::string& id) {
  v1::CancelJobRequest request;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*request.mutable_name(), Resource("jobs", id));
  v1::Job response;
  METAEKF_CLIENT_RETURN_IF_ERROR(
      impl_->Call(impl_->training, &TrainingService::Stub::CancelJob, request, &response));
  return FromProto(response);
}

}  // namespace metaekf::client
