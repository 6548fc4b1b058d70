#include "tests/server/support/client.h"

#include <grpcpp/generic/generic_stub.h>
#include <grpcpp/grpcpp.h>

#include <chrono>

#include "google/rpc/error_details.pb.h"
#include "google/rpc/status.pb.h"
#include "grpc/health/v1/health.grpc.pb.h"
#include "metaekf/v1/adaptation.grpc.pb.h"
#include "metaekf/v1/model.grpc.pb.h"
#include "metaekf/v1/prediction.grpc.pb.h"
#include "metaekf/v1/smoothing.grpc.pb.h"
#include "metaekf/v1/server_info.grpc.pb.h"
#include "metaekf/v1/training.grpc.pb.h"

namespace metaekf::server {
namespace {

class Context : public grpc::ClientContext {
 public:
  Context() { set_deadline(std::chrono::system_clock::now() + std::chrono::minutes(1)); }
};

template <class T>
Reply<T> Finished(const grpc::Status& status, T value) {
  Reply<T> reply;
  reply.code = static_cast<absl::StatusCode>(status.error_code());
  reply.message = status.error_message();
  reply.value = std::move(value);
  google::rpc::Status rich;
  if (!rich.ParseFromString(status.error_details())) return reply;
  for (const auto& any : rich.details()) {
    google::rpc::BadRequest bad;
    if (!any.UnpackTo(&bad)) continue;
    for (const auto& violation : bad.field_violations()) reply.fields.push_back(violation.field());
  }
  return reply;
}

template <class Response, class Request, class Method>
Reply<Response> Unary(const Request& request, const Method& method) {
  Context context;
  Response response;
  const grpc::Status status = method(&context, request, &response);
  return Finished(status, std::move(response));
}

template <class Response, class Request, class Method>
Reply<Response> Upload(const std::vector<Request>& requests, bool cancel, const Method& method) {
  Context context;
  Response response;
  auto writer = method(&context, &response);
  for (const Request& request : requests) {
    if (!writer->Write(request)) break;
  }
  if (cancel) {
    context.TryCancel();
  } else {
    writer->WritesDone();
  }
  const grpc::Status status = writer->Finish();
  return Finished(status, std::move(response));
}

template <class Response, class Reader>
Reply<std::vector<Response>> ReadAll(Reader& reader, grpc::ClientContext& context,
                                     const std::function<bool(const Response&)>& on_response) {
  std::vector<Response> responses;
  Response response;
  while (reader->Read(&response)) {
    responses.push_back(response);
    if (on_response && !on_response(response)) context.TryCancel();
  }
  return Finished(reader->Finish(), std::move(responses));
}

template <class Response, class Request, class Method>
Reply<std::vector<Response>> Bidi(const std::vector<Request>& requests, const Method& method,
                                  const std::function<bool(const Response&)>& on_response) {
  Context context;
  auto stream = method(&context);
  for (const Request& request : requests) {
    if (!stream->Write(request)) break;
  }
  stream->WritesDone();
  return ReadAll<Response>(stream, context, on_response);
}

}  // namespace

class Client::Stubs {
 public:
  explicit Stubs(const std::string& address)
      : channel(grpc::CreateChannel(address, grpc::InsecureChannelCredentials())),
        models(v1::ModelService::NewStub(channel)),
        training(v1::TrainingService::NewStub(channel)),
        adaptations(v1::AdaptationService::NewStub(channel)),
        predictions(v1::PredictionService::NewStub(channel)),
        smoothing(v1::SmoothingService::NewStub(channel)),
        server(v1::ServerService::NewStub(channel)),
        health(grpc::health::v1::Health::NewStub(channel)) {}

  std::shared_ptr<grpc::Channel> channel;
  std::unique_ptr<v1::ModelService::Stub> models;
  std::unique_ptr<v1::TrainingService::Stub> training;
  std::unique_ptr<v1::AdaptationService::Stub> adaptations;
  std::unique_ptr<v1::PredictionService::Stub> predictions;
  std::unique_ptr<v1::SmoothingService::Stub> smoothing;
  std::unique_ptr<v1::ServerService::Stub> server;
  std::unique_ptr<grpc::health::v1::Health::Stub> health;
};

Client::Client(const std::string& address) : stubs_(std::make_unique<Stubs>(address)) {}
Client::~Client() = default;

#define UNARY(Method, Response, stub)                                               \
  Reply<Response> Client::Call(const v1::Method##Request& request) {                \
    return Unary<Response>(request, [this](auto... arguments) {                     \
      return stubs_->stub->Method(std::forward<decltype(arguments)>(arguments)...); \
    });                                                                             \
  }
UNARY(ListModels, v1::ListModelsResponse, models)
UNARY(GetModel, v1::Model, models)
UNARY(ListModelVersions, v1::ListModelVersionsResponse, models)
UNARY(GetModelVersion, v1::ModelVersion, models)
UNARY(SetModelAlias, v1::ModelAlias, models)
UNARY(DeleteModelAlias, google::protobuf::Empty, models)
UNARY(DeleteModelVersion, google::protobuf::Empty, models)
UNARY(GetJob, v1::Job, training)
UNARY(ListJobs, v1::ListJobsResponse, training)
UNARY(CancelJob, v1::Job, training)
UNARY(GetAdaptation, v1::Adaptation, adaptations)
UNARY(ListAdaptations, v1::ListAdaptationsResponse, adaptations)
UNARY(DeleteAdaptation, google::protobuf::Empty, adaptations)
UNARY(GetServerInfo, v1::ServerInfo, server)
#undef UNARY

Reply<v1::ModelVersion> Client::Import(const std::vector<v1::ImportModelVersionRequest>& requests) {
  return Upload<v1::ModelVersion>(requests, false, [this](auto* context, auto* response) {
    return stubs_->models->ImportModelVersion(context, response);
  });
}

Reply<std::vector<v1::ExportModelVersionResponse>> Client::Call(
    const v1::ExportModelVersionRequest& request) {
  Context context;
  auto reader = stubs_->models->ExportModelVersion(&context, request);
  return ReadAll<v1::ExportModelVersionResponse>(reader, context, nullptr);
}

Reply<v1::Job> Client::CreateJob(const std::vector<v1::CreateTrainingJobRequest>& requests) {
  return Upload<v1::Job>(requests, false, [this](auto* context, auto* response) {
    return stubs_->training->CreateTrainingJob(context, response);
  });
}

Reply<v1::Job> Client::CreateJobAndCancel(
    const std::vector<v1::CreateTrainingJobRequest>& requests) {
  return Upload<v1::Job>(requests, true, [this](auto* context, auto* response) {
    return stubs_->training->CreateTrainingJob(context, response);
  });
}

Reply<std::vector<v1::WatchJobResponse>> Client::Watch(
    const std::string& name, const std::function<bool(const v1::WatchJobResponse&)>& on_response) {
  Context context;
  v1::WatchJobRequest request;
  request.set_name(name);
  auto reader = stubs_->training->WatchJob(&context, request);
  return ReadAll<v1::WatchJobResponse>(reader, context, on_response);
}

Reply<std::vector<v1::AdaptResponse>> Client::Adapt(
    const std::vector<v1::AdaptRequest>& requests,
    const std::function<bool(const v1::AdaptResponse&)>& on_response) {
  return Bidi<v1::AdaptResponse>(
      requests, [this](auto* context) { return stubs_->adaptations->Adapt(context); }, on_response);
}

Reply<std::vector<v1::PredictResponse>> Client::Predict(
    const std::vector<v1::PredictRequest>& requests) {
  return Bidi<v1::PredictResponse>(
      requests, [this](auto* context) { return stubs_->predictions->Predict(context); }, {});
}

Reply<std::vector<v1::SmoothResponse>> Client::Smooth(const std::vector<v1::SmoothRequest>& requests) {
  return Bidi<v1::SmoothResponse>(
      requests, [this](auto* context) { return stubs_->smoothing->Smooth(context); }, {});
}

std::string Client::Health(const std::string& service) {
  grpc::health::v1::HealthCheckRequest request;
  request.set_service(service);
  const auto reply = Unary<grpc::health::v1::HealthCheckResponse>(
      request,
      [this](auto... arguments) { return stubs_->health->Check(arguments...); });
  if (!reply.ok()) return absl::StatusCodeToString(reply.code);
  return grpc::health::v1::HealthCheckResponse::ServingStatus_Name(reply.value.status());
}

std::string Client::ReflectedServices() {
  Context context;
  grpc::CompletionQueue queue;
  const auto next = [&queue] {
    void* tag = nullptr;
    bool ok = false;
    queue.Next(&tag, &ok);
  };
  grpc::GenericStub stub(stubs_->channel);
  const auto call = stub.PrepareCall(
      &context, "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo", &queue);
  call->StartCall(nullptr);
  next();
  // ServerReflectionRequest {list_services: "*"}; Debian does not ship its .proto file.
  const grpc::Slice request("\x3a\x01*");
  call->Write(grpc::ByteBuffer(&request, 1), nullptr);
  next();
  grpc::ByteBuffer response;
  call->Read(&response, nullptr);
  next();
  grpc::Slice bytes;
  (void)response.DumpToSingleSlice(&bytes);
  context.TryCancel();
  grpc::Status status;
  call->Finish(&status, nullptr);
  next();
  return std::string(reinterpret_cast<const char*>(bytes.begin()), bytes.size());
}

}  // namespace metaekf::server
