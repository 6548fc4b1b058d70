#include "metaekf/v1/server_info.grpc.pb.h"
#include "server/handlers/server_handlers.h"
#include "server/handlers/services.h"
#include "server/handlers/unary_call.h"

namespace metaekf::server {
namespace {

using store::Scope;

class ServerService final : public v1::ServerService::CallbackService {
 public:
  explicit ServerService(const ServiceContext& context) : context_(context) {}

  grpc::ServerUnaryReactor* GetServerInfo(grpc::CallbackServerContext* call,
                                          const v1::GetServerInfoRequest* request,
                                          v1::ServerInfo* response) override {
    return RunUnary(call, context_, {"GetServerInfo", Scope::kRead}, server::GetServerInfo, request, response);
  }
  grpc::ServerUnaryReactor* GetMetrics(grpc::CallbackServerContext* call, const v1::GetMetricsRequest* request,
                                       v1::GetMetricsResponse* response) override {
    return RunUnary(call, context_, {"GetMetrics", Scope::kAdmin}, server::GetMetrics, request, response);
  }

 private:
  const ServiceContext& context_;
};

}  // namespace

std::unique_ptr<grpc::Service> MakeServerService(const ServiceContext& context) {
  return std::make_unique<ServerService>(context);
}

}  // namespace metaekf::server
