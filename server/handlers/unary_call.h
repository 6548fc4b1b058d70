#pragma once

#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

#include <utility>

#include "server/executor/background_executor.h"
#include "server/handlers/admitted.h"
#include "server/handlers/overload.h"
#include "server/status/grpc_status.h"

namespace metaekf::server {

/// Answers a call with what `work`, which returns an absl::Status, leaves in its response. Request
/// and response live until then.
template <class Work>
grpc::ServerUnaryReactor* FinishWith(grpc::CallbackServerContext* call,
                                     BackgroundExecutor& executor, Work work) {
  grpc::ServerUnaryReactor* reactor = call->DefaultReactor();
  const bool accepted = executor.Submit([call, reactor, work = std::move(work)]() mutable {
    if (call->IsCancelled()) return reactor->Finish(grpc::Status::CANCELLED);
    reactor->Finish(ToGrpcStatus(work()));
  });
  if (!accepted) reactor->Finish(ToGrpcStatus(Overloaded()));
  return reactor;
}

/// Answers a call with what a handler of this folder leaves in the response, if the caller may.
template <class Request, class Response>
grpc::ServerUnaryReactor* RunUnary(grpc::CallbackServerContext* call, const ServiceContext& server,
                                   store::Scope scope,
                                   absl::Status (*handler)(CallContext&, const Request&, Response*),
                                   const Request* request, Response* response) {
  return Admitted<grpc::ServerUnaryReactor>(call, server, scope, [&](CallContext context) {
    return FinishWith(call, server.io,
                      [handler, request, response, context = std::move(context)]() mutable {
                        return handler(context, *request, response);
                      });
  });
}

}  // namespace metaekf::server
