#include "metaekf/v1/adaptation.grpc.pb.h"
#include "server/handlers/adaptation_handlers.h"
#include "server/handlers/bidi_call.h"
#include "server/handlers/services.h"
#include "server/handlers/unary_call.h"

namespace metaekf::server {
namespace {

using store::Scope;

using grpc::CallbackServerContext;
using grpc::ServerUnaryReactor;

class AdaptationService final : public v1::AdaptationService::CallbackService {
 public:
  explicit AdaptationService(const ServiceContext& context) : context_(context) {}

  grpc::ServerBidiReactor<v1::AdaptRequest, v1::AdaptResponse>* Adapt(
      CallbackServerContext* call) override {
    using Reactor = grpc::ServerBidiReactor<v1::AdaptRequest, v1::AdaptResponse>;
    return Admitted<Reactor>(call, context_, {"Adapt", Scope::kWrite}, [&](CallContext context, const auto& record) {
      return new BidiCall(call, record, server::Adapt(std::move(context)), context_.io, context_.compute);
    });
  }
  ServerUnaryReactor* GetAdaptation(CallbackServerContext* call,
                                    const v1::GetAdaptationRequest* request,
                                    v1::Adaptation* response) override {
    return RunUnary(call, context_, {"GetAdaptation", Scope::kRead}, server::GetAdaptation, request, response);
  }
  ServerUnaryReactor* ListAdaptations(CallbackServerContext* call,
                                      const v1::ListAdaptationsRequest* request,
                                      v1::ListAdaptationsResponse* response) override {
    return RunUnary(call, context_, {"ListAdaptations", Scope::kRead}, server::ListAdaptations, request, response);
  }
  ServerUnaryReactor* DeleteAdaptation(CallbackServerContext* call,
                                       const v1::DeleteAdaptationRequest* request,
                                       google::protobuf::Empty* response) override {
    return RunUnary(call, context_, {"DeleteAdaptation", Scope::kWrite}, server::DeleteAdaptation, request, response);
  }

 private:
  const ServiceContext& context_;
};

}  // namespace

std::unique_ptr<grpc::Service> MakeAdaptationService(const ServiceContext& context) {
  return std::make_unique<AdaptationService>(context);
}

}  // namespace metaekf::server
