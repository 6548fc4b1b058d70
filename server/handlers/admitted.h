#pragma once

#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

#include <memory>
#include <utility>

#include "server/access/exposure.h"
#include "server/handlers/call_context.h"
#include "server/handlers/call_record.h"

namespace metaekf::server {

inline Credentials CredentialsOf(const grpc::CallbackServerContext& call) {
  Credentials credentials;
  const auto found = call.client_metadata().find("authorization");
  if (found != call.client_metadata().end()) {
    credentials.authorization = std::string(found->second.data(), found->second.size());
  }
  // Names of a certificate that the connection's handshake has checked.
  for (const grpc::string_ref& name : call.auth_context()->GetPeerIdentity()) {
    credentials.certificate_names.emplace_back(name.data(), name.size());
  }
  credentials.peer_host = PeerHost(call.peer());
  return credentials;
}

/// A call that ends before it has begun. Owns itself.
template <class Reactor>
class RefusedCall final : public Reactor {
 public:
  explicit RefusedCall(const grpc::Status& status) { this->Finish(status); }
  void OnDone() override { delete this; }
};

/// The reactor that `make` makes of the call's context and its record, if the caller may do what needs rpc.scope; else
/// one that says why not. Every RPC comes through here.
template <class Reactor, class Make>
Reactor* Admitted(grpc::CallbackServerContext* call, const ServiceContext& server, const Rpc& rpc, const Make& make) {
  const auto record = std::make_shared<CallRecord>(rpc, *call, server.metrics, server.live_calls);
  absl::StatusOr<Caller> caller = server.access.Admit(CredentialsOf(*call), rpc.scope);
  if (!caller.ok()) return new RefusedCall<Reactor>(record->End(caller.status()));
  record->SetCaller(*caller);
  store::TenantStore store = server.store.Of(caller->tenant, caller->identity);
  return make(CallContext{server, *std::move(caller), std::move(store)}, record);
}

}  // namespace metaekf::server
