#pragma once

#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

#include "server/executor/background_executor.h"
#include "server/handlers/overload.h"
#include "server/handlers/service_context.h"
#include "server/status/grpc_status.h"

namespace metaekf::server {

/// Answers a call with what `handler` leaves in the response.
template <class Request, class Response>
grpc::ServerUnaryReactor* RunUnary(grpc::CallbackServerContext* call, BackgroundExecutor& executor,
                                   absl::Status (*handler)(const ServiceContext&, const Request&,
                                                           Response*),
                                   const ServiceContext& context, const Request* request,
                                   Response* response) {
  grpc::ServerUnaryReactor* reactor = call->DefaultReactor();
  const bool accepted = executor.Submit([=, &context] {
    if (call->IsCancelled()) return reactor->Finish(grpc::Status::CANCELLED);
    reactor->Finish(ToGrpcStatus(handler(context, *request, response)));
  });
  if (!accepted) reactor->Finish(ToGrpcStatus(Overloaded()));
  return reactor;
}

}  // namespace metaekf::server
