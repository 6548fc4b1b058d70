#include "metaekf/v1/admin.grpc.pb.h"
#include "server/handlers/admin_handlers.h"
#include "server/handlers/admitted.h"
#include "server/handlers/download_call.h"
#include "server/handlers/services.h"
#include "server/handlers/unary_call.h"

namespace metaekf::server {
namespace {

using grpc::CallbackServerContext;
using grpc::ServerUnaryReactor;
using store::Scope;

class AdminService final : public v1::AdminService::CallbackService {
 public:
  explicit AdminService(const ServiceContext& context) : context_(context) {}

  ServerUnaryReactor* CreateToken(CallbackServerContext* call,
                                  const v1::CreateTokenRequest* request,
                                  v1::CreateTokenResponse* response) override {
    return RunUnary(call, context_, {"CreateToken", Scope::kAdmin}, server::CreateToken, request, response);
  }
  ServerUnaryReactor* ListTokens(CallbackServerContext* call, const v1::ListTokensRequest* request,
                                 v1::ListTokensResponse* response) override {
    return RunUnary(call, context_, {"ListTokens", Scope::kAdmin}, server::ListTokens, request, response);
  }
  ServerUnaryReactor* RevokeToken(CallbackServerContext* call,
                                  const v1::RevokeTokenRequest* request,
                                  v1::Token* response) override {
    return RunUnary(call, context_, {"RevokeToken", Scope::kAdmin}, server::RevokeToken, request, response);
  }
  ServerUnaryReactor* ListAuditEntries(CallbackServerContext* call,
                                       const v1::ListAuditEntriesRequest* request,
                                       v1::ListAuditEntriesResponse* response) override {
    return RunUnary(call, context_, {"ListAuditEntries", Scope::kAdmin}, server::ListAuditEntries, request, response);
  }
  grpc::ServerWriteReactor<v1::CreateBackupResponse>* CreateBackup(CallbackServerContext* call,
                                                                    const v1::CreateBackupRequest*) override {
    using Reactor = grpc::ServerWriteReactor<v1::CreateBackupResponse>;
    return Admitted<Reactor>(call, context_, {"CreateBackup", Scope::kAdmin}, [&](CallContext context, const auto& record) {
      return new DownloadCall(record, server::CreateBackup(std::move(context)), context_.io);
    });
  }

 private:
  const ServiceContext& context_;
};

}  // namespace

std::unique_ptr<grpc::Service> MakeAdminService(const ServiceContext& context) {
  return std::make_unique<AdminService>(context);
}

}  // namespace metaekf::server
