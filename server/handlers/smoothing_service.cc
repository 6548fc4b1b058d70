#include "metaekf/v1/smoothing.grpc.pb.h"
#include "server/handlers/admitted.h"
#include "server/handlers/bidi_call.h"
#include "server/handlers/smoothing_handlers.h"
#include "server/handlers/services.h"

namespace metaekf::server {
namespace {

using store::Scope;

class SmoothingService final : public v1::SmoothingService::CallbackService {
 public:
  explicit SmoothingService(const ServiceContext& context) : context_(context) {}

  grpc::ServerBidiReactor<v1::SmoothRequest, v1::SmoothResponse>* Smooth(
      grpc::CallbackServerContext* call) override {
    using Reactor = grpc::ServerBidiReactor<v1::SmoothRequest, v1::SmoothResponse>;
    return Admitted<Reactor>(call, context_, {"Smooth", Scope::kRead}, [&](CallContext context, const auto& record) {
      return new BidiCall(call, record, server::Smooth(std::move(context)), context_.compute, context_.compute);
    });
  }

 private:
  const ServiceContext& context_;
};

}  // namespace

std::unique_ptr<grpc::Service> MakeSmoothingService(const ServiceContext& context) {
  return std::make_unique<SmoothingService>(context);
}

}  // namespace metaekf::server
