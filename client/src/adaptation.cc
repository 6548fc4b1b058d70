#include "client/src/impl.h"

namespace metaekf::client {

using v1::AdaptationService;

Result<Adaptation> Client::Adapt(const AdaptationRequest& request,
                                 const std::function<bool(const AdaptationProgress&)>& on_step) {
  v1::AdaptRequest first;
  auto* options = first.mutable_options();
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*options->mutable_model(), ModelResource(request.model));
  options->set_adaptation_id(request.adaptation_id);
  options->set_request_id(request.request_id);
  options->set_method(ToProto(request.method));
  ToProto(request.inner_loop, options->mutable_inner_loop());
  options->set_seed(request.seed);
  options->set_require_better_than_arx(request.require_better_than_arx);

  using Stream = grpc::ClientReaderWriter<v1::AdaptRequest, v1::AdaptResponse>;
  impl_->Connect();
  grpc::ClientContext context;
  impl_->Authorise(context);
  const std::unique_ptr<Stream> stream = impl_->adaptations->Adapt(&context);
  const auto write = [&](Stream& out) {
    if (!out.Write(first)) return Status();
    return SendSamples(request.context, [&out](v1::Samples samples) {
      v1::AdaptRequest message;
      *message.mutable_samples() = std::move(samples);
      return out.Write(message);
    });
  };
  std::optional<Adaptation> result;
  const auto on_response = [&](const v1::AdaptResponse& response) {
    if (response.has_result()) result = FromProto(response.result());
    if (!response.has_progress() || !on_step) return true;
    const auto& progress = response.progress();
    return on_step({progress.step(), progress.steps(), progress.loss()});
  };
  METAEKF_CLIENT_RETURN_IF_ERROR(
      (impl_->Exchange<v1::AdaptRequest, v1::AdaptResponse>(context, *stream, write, on_response)));
  if (!result) return Error(Code::kInternal, "the server ended the adaptation without a result");
  return *result;
}

Result<Adaptation> Client::GetAdaptation(const std::string& id) {
  v1::GetAdaptationRequest request;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*request.mutable_name(), Resource("adaptations", id));
  v1::Adaptation response;
  METAEKF_CLIENT_RETURN_IF_ERROR(
      impl_->Call(impl_->adaptations, &AdaptationService::Stub::GetAdaptation, request, &response));
  return FromProto(response);
}

Result<std::vector<Adaptation>> Client::ListAdaptations() {
  return impl_->List<Adaptation>(impl_->adaptations, &AdaptationService::Stub::ListAdaptations,
                                 v1::ListAdaptationsRequest(),
                                 &v1::ListAdaptationsResponse::adaptations);
}

Status Client::DeleteAdaptation(const std::string& id) {
  v1::DeleteAdaptationRequest request;
  METAEKF_CLIENT_ASSIGN_OR_RETURN(*request.mutable_name(), Resource("adaptations", id));
  google::protobuf::Empty response;
  return impl_->Call(impl_->adaptations, &AdaptationService::Stub::DeleteAdaptation, request, &response);
}

}  // namespace metaekf::client
