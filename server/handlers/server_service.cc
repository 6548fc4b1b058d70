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
    return RunUnary(call, context_, Scope::kRead, server::GetServerInfo, request, response);
  }

 private:
  const ServiceContext& context_;
};

}  // namespace

std::unique_ptr<grpc::Service> MakeServerService(const ServiceContext& context) {
  return std::make_unique<ServerService>(context);
}

}  // namespace metaekf::server
