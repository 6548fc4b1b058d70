#include "metaekf/v1/model.grpc.pb.h"
#include "server/handlers/download_call.h"
#include "server/handlers/model_handlers.h"
#include "server/handlers/services.h"
#include "server/handlers/unary_call.h"
#include "server/handlers/upload_call.h"

namespace metaekf::server {
namespace {

using store::Scope;

using grpc::CallbackServerContext;
using grpc::ServerUnaryReactor;

class ModelService final : public v1::ModelService::CallbackService {
 public:
  explicit ModelService(const ServiceContext& context) : context_(context) {}

  ServerUnaryReactor* ListModels(CallbackServerContext* call, const v1::ListModelsRequest* request,
                                 v1::ListModelsResponse* response) override {
    return RunUnary(call, context_, {"ListModels", Scope::kRead}, server::ListModels, request, response);
  }
  ServerUnaryReactor* GetModel(CallbackServerContext* call, const v1::GetModelRequest* request,
                               v1::Model* response) override {
    return RunUnary(call, context_, {"GetModel", Scope::kRead}, server::GetModel, request, response);
  }
  ServerUnaryReactor* ListModelVersions(CallbackServerContext* call,
                                        const v1::ListModelVersionsRequest* request,
                                        v1::ListModelVersionsResponse* response) override {
    return RunUnary(call, context_, {"ListModelVersions", Scope::kRead}, server::ListModelVersions, request, response);
  }
  ServerUnaryReactor* GetModelVersion(CallbackServerContext* call,
                                      const v1::GetModelVersionRequest* request,
                                      v1::ModelVersion* response) override {
    return RunUnary(call, context_, {"GetModelVersion", Scope::kRead}, server::GetModelVersion, request, response);
  }
  ServerUnaryReactor* SetModelAlias(CallbackServerContext* call,
                                    const v1::SetModelAliasRequest* request,
                                    v1::ModelAlias* response) override {
    return RunUnary(call, context_, {"SetModelAlias", Scope::kWrite}, server::SetModelAlias, request, response);
  }
  ServerUnaryReactor* DeleteModelAlias(CallbackServerContext* call,
                                       const v1::DeleteModelAliasRequest* request,
                                       Empty* response) override {
    return RunUnary(call, context_, {"DeleteModelAlias", Scope::kWrite}, server::DeleteModelAlias, request, response);
  }
  ServerUnaryReactor* DeleteModelVersion(CallbackServerContext* call,
                                         const v1::DeleteModelVersionRequest* request,
                                         Empty* response) override {
    return RunUnary(call, context_, {"DeleteModelVersion", Scope::kWrite}, server::DeleteModelVersion, request, response);
  }

  grpc::ServerReadReactor<v1::ImportModelVersionRequest>* ImportModelVersion(
      CallbackServerContext* call, v1::ModelVersion* response) override {
    using Reactor = grpc::ServerReadReactor<v1::ImportModelVersionRequest>;
    return Admitted<Reactor>(call, context_, {"ImportModelVersion", Scope::kWrite}, [&](CallContext context, const auto& record) {
      return new UploadCall(call, record, server::ImportModelVersion(std::move(context)), context_.io,
                            response);
    });
  }
  grpc::ServerWriteReactor<v1::ExportModelVersionResponse>* ExportModelVersion(
      CallbackServerContext* call, const v1::ExportModelVersionRequest* request) override {
    using Reactor = grpc::ServerWriteReactor<v1::ExportModelVersionResponse>;
    return Admitted<Reactor>(call, context_, {"ExportModelVersion", Scope::kRead}, [&](CallContext context, const auto& record) {
      return new DownloadCall(record, server::ExportModelVersion(std::move(context), *request),
                              context_.io);
    });
  }

 private:
  const ServiceContext& context_;
};

}  // namespace

std::unique_ptr<grpc::Service> MakeModelService(const ServiceContext& context) {
  return std::make_unique<ModelService>(context);
}

}  // namespace metaekf::server
