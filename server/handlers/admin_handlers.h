#pragma once

#include <memory>

#include "metaekf/v1/admin.pb.h"
#include "server/handlers/call_context.h"
#include "server/handlers/stream_handler.h"

/// What the RPCs of AdminService do; admin.proto says what that is.
namespace metaekf::server {

absl::Status CreateToken(CallContext& context, const v1::CreateTokenRequest& request,
                         v1::CreateTokenResponse* response);
absl::Status ListTokens(CallContext& context, const v1::ListTokensRequest& request,
                        v1::ListTokensResponse* response);
absl::Status RevokeToken(CallContext& context, const v1::RevokeTokenRequest& request,
                         v1::Token* response);
absl::Status ListAuditEntries(CallContext& context, const v1::ListAuditEntriesRequest& request,
                              v1::ListAuditEntriesResponse* response);

std::unique_ptr<ResponseSource<v1::CreateBackupResponse>> CreateBackup(CallContext context);

}  // namespace metaekf::server
