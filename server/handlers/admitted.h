#pragma once

#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

#include <utility>

#include "server/handlers/call_context.h"
#include "server/status/grpc_status.h"

namespace metaekf::server {

inline Credentials CredentialsOf(const grpc::CallbackServerContext& call) {
  Credentials credentials;
  const auto found = call.client_metadata().find("authorization");
  if (found != call.client_metadata().end()) {
    credentials.authorization = std::string(found->second.data(), found->second.size());
  }
  return credentials;
}

/// A call that ends before it has begun. Owns itself.
template <class Reactor>
class RefusedCall final : public Reactor {
 public:
  explicit RefusedCall(const absl::Status& status) { this->Finish(ToGrpcStatus(status)); }
  void OnDone() override { delete this; }
};

/// The reactor that `make` makes of the call's context, if the caller may do what needs `scope`; else
/// one that says why not. Every RPC comes through here.
template <class Reactor, class Make>
Reactor* Admitted(const grpc::CallbackServerContext* call, const ServiceContext& server,
                  store::Scope scope, const Make& make) {
  absl::StatusOr<Caller> caller = server.access.Admit(CredentialsOf(*call), scope);
  if (!caller.ok()) return new RefusedCall<Reactor>(caller.status());
  store::TenantStore store = server.store.Of(caller->tenant, caller->identity);
  return make(CallContext{server, *std::move(caller), std::move(store)});
}

}  // namespace metaekf::server
