#include "metaekf/v1/training.grpc.pb.h"
#include "server/handlers/services.h"
#include "server/handlers/training_handlers.h"
#include "server/handlers/unary_call.h"
#include "server/handlers/upload_call.h"
#include "server/handlers/watch_call.h"

namespace metaekf::server {
namespace {

using store::Scope;

using grpc::CallbackServerContext;
using grpc::ServerUnaryReactor;

class TrainingService final : public v1::TrainingService::CallbackService {
 public:
  explicit TrainingService(const ServiceContext& context) : context_(context) {}

  grpc::ServerReadReactor<v1::CreateTrainingJobRequest>* CreateTrainingJob(
      CallbackServerContext* call, v1::Job* response) override {
    using Reactor = grpc::ServerReadReactor<v1::CreateTrainingJobRequest>;
    return Admitted<Reactor>(call, context_, {"CreateTrainingJob", Scope::kWrite}, [&](CallContext context, const auto& record) {
      return new UploadCall(call, record, server::CreateTrainingJob(std::move(context)), context_.io,
                            response);
    });
  }
  ServerUnaryReactor* GetJob(CallbackServerContext* call, const v1::GetJobRequest* request,
                             v1::Job* response) override {
    return RunUnary(call, context_, {"GetJob", Scope::kRead}, server::GetJob, request, response);
  }
  ServerUnaryReactor* ListJobs(CallbackServerContext* call, const v1::ListJobsRequest* request,
                               v1::ListJobsResponse* response) override {
    return RunUnary(call, context_, {"ListJobs", Scope::kRead}, server::ListJobs, request, response);
  }
  grpc::ServerWriteReactor<v1::WatchJobResponse>* WatchJob(
      CallbackServerContext* call, const v1::WatchJobRequest* request) override {
    using Reactor = grpc::ServerWriteReactor<v1::WatchJobResponse>;
    return Admitted<Reactor>(call, context_, {"WatchJob", Scope::kRead}, [&](CallContext context, const auto& record) {
      return new WatchCall(std::move(context), record, request->name());
    });
  }
  ServerUnaryReactor* CancelJob(CallbackServerContext* call, const v1::CancelJobRequest* request,
                                v1::Job* response) override {
    return RunUnary(call, context_, {"CancelJob", Scope::kWrite}, server::CancelJob, request, response);
  }

 private:
  const ServiceContext& context_;
};

}  // namespace

std::unique_ptr<grpc::Service> MakeTrainingService(const ServiceContext& context) {
  return std::make_unique<TrainingService>(context);
}

}  // namespace metaekf::server
