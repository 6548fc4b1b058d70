#pragma once

#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

#include <utility>

#include "server/executor/background_executor.h"
#include "server/handlers/admitted.h"
#include "server/handlers/overload.h"

namespace metaekf::server {

/// Answers a call with what `work`, which returns an absl::Status, leaves in its response. Request
/// and response live until then.
template <class Work>
grpc::ServerUnaryReactor* FinishWith(grpc::CallbackServerContext* call, std::shared_ptr<CallRecord> record,
                                     BackgroundExecutor& executor, Work work) {
  grpc::ServerUnaryReactor* reactor = call->DefaultReactor();
  const bool accepted = executor.Submit([call, record, reactor, work = std::move(work)]() mutable {
    const bool cancelled = call->IsCancelled();
    reactor->Finish(record->End(cancelled ? absl::CancelledError("the call was cancelled") : work()));
  });
  if (!accepted) reactor->Finish(record->End(Overloaded()));
  return reactor;
}

/// Answers a call with what a handler of this folder leaves in the response, if the caller may.
template <class Request, class Response>
grpc::ServerUnaryReactor* RunUnary(grpc::CallbackServerContext* call, const ServiceContext& server,
                                   const Rpc& rpc,
                                   absl::Status (*handler)(CallContext&, const Request&, Response*),
                                   const Request* request, Response* response) {
  return Admitted<grpc::ServerUnaryReactor>(call, server, rpc, [&](CallContext context, const auto& record) {
    return FinishWith(call, record, server.io,
                      [handler, request, response, context = std::move(context)]() mutable {
                        return handler(context, *request, response);
                      });
  });
}

}  // namespace metaekf::server
