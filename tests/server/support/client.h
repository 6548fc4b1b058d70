#pragma once

#include <google/protobuf/empty.pb.h>

#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "metaekf/v1/adaptation.pb.h"
#include "metaekf/v1/model.pb.h"
#include "metaekf/v1/prediction.pb.h"
#include "metaekf/v1/server_info.pb.h"
#include "metaekf/v1/smoothing.pb.h"
#include "metaekf/v1/training.pb.h"

namespace metaekf::server {

/// What a call came to.
template <class T>
struct Reply {
  absl::StatusCode code = absl::StatusCode::kUnknown;
  std::string message;
  std::vector<std::string> fields;  ///< of the violations in the error's details
  T value;

  bool ok() const { return code == absl::StatusCode::kOk; }
};

/// Prints code, message and fields when a test fails.
template <class T>
std::ostream& operator<<(std::ostream& out, const Reply<T>& reply) {
  out << absl::StatusCodeToString(reply.code) << ": " << reply.message;
  for (const std::string& field : reply.fields) out << " [" << field << "]";
  return out;
}

/// A client for tests, without gRPC headers. Every call has a deadline of a minute.
class Client {
 public:
  /// @param address  HOST:PORT.
  explicit Client(const std::string& address);
  ~Client();

  using Empty = google::protobuf::Empty;

  Reply<v1::ListModelsResponse> Call(const v1::ListModelsRequest& request);
  Reply<v1::Model> Call(const v1::GetModelRequest& request);
  Reply<v1::ListModelVersionsResponse> Call(const v1::ListModelVersionsRequest& request);
  Reply<v1::ModelVersion> Call(const v1::GetModelVersionRequest& request);
  Reply<v1::ModelAlias> Call(const v1::SetModelAliasRequest& request);
  Reply<Empty> Call(const v1::DeleteModelAliasRequest& request);
  Reply<Empty> Call(const v1::DeleteModelVersionRequest& request);
  Reply<v1::ModelVersion> Import(const std::vector<v1::ImportModelVersionRequest>& requests);
  Reply<std::vector<v1::ExportModelVersionResponse>> Call(
      const v1::ExportModelVersionRequest& request);

  Reply<v1::Job> CreateJob(const std::vector<v1::CreateTrainingJobRequest>& requests);
  /// Breaks the call off instead of ending its requests.
  Reply<v1::Job> CreateJobAndCancel(const std::vector<v1::CreateTrainingJobRequest>& requests);
  Reply<v1::Job> Call(const v1::GetJobRequest& request);
  Reply<v1::ListJobsResponse> Call(const v1::ListJobsRequest& request);
  Reply<v1::Job> Call(const v1::CancelJobRequest& request);
  /// @param on_response  false breaks the call off.
  Reply<std::vector<v1::WatchJobResponse>> Watch(
      const std::string& name,
      const std::function<bool(const v1::WatchJobResponse&)>& on_response = nullptr);

  /// @param on_response  false breaks the call off.
  Reply<std::vector<v1::AdaptResponse>> Adapt(
      const std::vector<v1::AdaptRequest>& requests,
      const std::function<bool(const v1::AdaptResponse&)>& on_response = nullptr);
  Reply<v1::Adaptation> Call(const v1::GetAdaptationRequest& request);
  Reply<v1::ListAdaptationsResponse> Call(const v1::ListAdaptationsRequest& request);
  Reply<Empty> Call(const v1::DeleteAdaptationRequest& request);

  Reply<std::vector<v1::PredictResponse>> Predict(const std::vector<v1::PredictRequest>& requests);
  Reply<std::vector<v1::SmoothResponse>> Smooth(const std::vector<v1::SmoothRequest>& requests);
  Reply<v1::ServerInfo> Call(const v1::GetServerInfoRequest& request);

  /// grpc.health.v1: "SERVING", "NOT_SERVING", or the name of the error's code.
  std::string Health(const std::string& service = "");
  /// The bytes with which reflection answers to a request for the list of services.
  std::string ReflectedServices();

 private:
  class Stubs;
  std::unique_ptr<Stubs> stubs_;
};

}  // namespace metaekf::server
