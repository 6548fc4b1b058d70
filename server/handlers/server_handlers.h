#pragma once

#include "metaekf/v1/server_info.pb.h"
#include "server/handlers/call_context.h"

namespace metaekf::server {

/// ServerService.GetServerInfo, as server_info.proto describes it.
absl::Status GetMetrics(CallContext& context, const v1::GetMetricsRequest& request,
                        v1::GetMetricsResponse* response);
absl::Status GetServerInfo(CallContext& context, const v1::GetServerInfoRequest& request,
                           v1::ServerInfo* response);

}  // namespace metaekf::server
