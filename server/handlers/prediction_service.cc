#include "metaekf/v1/prediction.grpc.pb.h"
#include "server/handlers/admitted.h"
#include "server/handlers/bidi_call.h"
#include "server/handlers/prediction_handlers.h"
#include "server/handlers/services.h"

namespace metaekf::server {
namespace {

using store::Scope;

class PredictionService final : public v1::PredictionService::CallbackService {
 public:
  explicit PredictionService(const ServiceContext& context) : context_(context) {}

  grpc::ServerBidiReactor<v1::PredictRequest, v1::PredictResponse>* Predict(
      grpc::CallbackServerContext* call) override {
    using Reactor = grpc::ServerBidiReactor<v1::PredictRequest, v1::PredictResponse>;
    return Admitted<Reactor>(call, context_, {"Predict", Scope::kRead}, [&](CallContext context, const auto& record) {
      return new BidiCall(call, record, server::Predict(std::move(context)), context_.compute, context_.compute);
    });
  }

 private:
  const ServiceContext& context_;
};

}  // namespace

std::unique_ptr<grpc::Service> MakePredictionService(const ServiceContext& context) {
  return std::make_unique<PredictionService>(context);
}

}  // namespace metaekf::server
