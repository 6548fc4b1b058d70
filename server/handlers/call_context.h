#pragma once

#include "server/access/access_control.h"
#include "server/handlers/service_context.h"

namespace metaekf::server {

/// What an admitted call works with: the server's parts, and what the caller's tenant has. Made by
/// Admitted (admitted.h) alone, which asks whether the caller may.
struct CallContext {
  const ServiceContext& server;
  Caller caller;
  store::TenantStore store;
};

}  // namespace metaekf::server
