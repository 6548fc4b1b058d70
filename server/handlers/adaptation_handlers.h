#pragma once

#include <google/protobuf/empty.pb.h>

#include <memory>

#include "metaekf/v1/adaptation.pb.h"
#include "server/handlers/call_context.h"
#include "server/handlers/stream_handler.h"

/// The RPCs of AdaptationService, as adaptation.proto describes them.
namespace metaekf::server {

std::unique_ptr<StreamHandler<v1::AdaptRequest, v1::AdaptResponse>> Adapt(
    CallContext context);
absl::Status GetAdaptation(CallContext& context, const v1::GetAdaptationRequest& request,
                           v1::Adaptation* response);
absl::Status ListAdaptations(CallContext& context,
                             const v1::ListAdaptationsRequest& request,
                             v1::ListAdaptationsResponse* response);
absl::Status DeleteAdaptation(CallContext& context,
                              const v1::DeleteAdaptationRequest& request,
                              google::protobuf::Empty* response);

}  // namespace metaekf::server
