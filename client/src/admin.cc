#include <algorithm>
#include <cmath>

#include "client/src/impl.h"

namespace metaekf::client {
namespace {

constexpr char kPrefix[] = "tokens/";

}  // namespace

Result<NewToken> Client::CreateToken(const TokenRequest& request) {
  v1::CreateTokenRequest message;
  message.set_tenant(request.tenant);
  message.set_scope(static_cast<v1::Scope>(static_cast<int>(request.scope) + 1));
  message.set_note(request.note);
  if (request.lifetime_s) {
    const double seconds = std::floor(*request.lifetime_s);
    message.mutable_lifetime()->set_seconds(static_cast<int64_t>(seconds));
    message.mutable_lifetime()->set_nanos(
        static_cast<int32_t>(std::lround(1e9 * (*request.lifetime_s - seconds))));
  }
  v1::CreateTokenResponse response;
  METAEKF_CLIENT_RETURN_IF_ERROR(
      impl_->Call(impl_->admin, &v1::AdminService::Stub::CreateToken, message, &response));
  return NewToken{FromProto(response.token()), response.secret()};
}

Result<std::vector<Token>> Client::ListTokens() {
  v1::ListTokensResponse response;
  METAEKF_CLIENT_RETURN_IF_ERROR(impl_->Call(
      impl_->admin, &v1::AdminService::Stub::ListTokens, v1::ListTokensRequest(), &response));
  std::vector<Token> tokens;
  for (const v1::Token& token : response.tokens()) tokens.push_back(FromProto(token));
  return tokens;
}

Result<Token> Client::RevokeToken(const std::string& id) {
  v1::RevokeTokenRequest request;
  request.set_name(kPrefix + id);
  v1::Token response;
  METAEKF_CLIENT_RETURN_IF_ERROR(
      impl_->Call(impl_->admin, &v1::AdminService::Stub::RevokeToken, request, &response));
  return FromProto(response);
}

Result<std::vector<AuditEntry>> Client::ListAuditEntries(const std::string& tenant, size_t most) {
  constexpr size_t kPage = 1000;
  std::vector<AuditEntry> entries;
  v1::ListAuditEntriesRequest request;
  request.set_tenant(tenant);
  do {
    request.set_page_size(static_cast<int32_t>(std::min(kPage, most - entries.size())));
    v1::ListAuditEntriesResponse page;
    METAEKF_CLIENT_RETURN_IF_ERROR(
        impl_->Call(impl_->admin, &v1::AdminService::Stub::ListAuditEntries, request, &page));
    for (const v1::AuditEntry& entry : page.entries()) entries.push_back(FromProto(entry));
    request.set_page_token(page.next_page_token());
  } while (!request.page_token().empty() && entries.size() < most);
  return entries;
}

Result<std::vector<MetricFamily>> Client::GetMetrics() {
  v1::GetMetricsResponse response;
  METAEKF_CLIENT_RETURN_IF_ERROR(
      impl_->Call(impl_->server, &v1::ServerService::Stub::GetMetrics, v1::GetMetricsRequest(), &response));
  std::vector<MetricFamily> families;
  for (const v1::MetricFamily& family : response.families()) families.push_back(FromProto(family));
  return families;
}

Status Client::CreateBackup(BackupSink& sink) {
  impl_->Connect();
  grpc::ClientContext context;
  impl_->Authorise(context);
  const auto stream = impl_->admin->CreateBackup(&context, v1::CreateBackupRequest());
  const auto take = [&](const v1::CreateBackupResponse& response) {
    if (response.has_header()) return sink.Begin(FromProto(response.header()));
    if (response.has_file()) {
      return sink.File({response.file().path(), response.file().size_bytes(), response.file().sha256()});
    }
    return sink.Bytes(response.chunk());
  };
  v1::CreateBackupResponse response;
  Status taken;
  while (stream->Read(&response)) {
    if (taken.ok()) taken = take(response);
    if (!taken.ok()) context.TryCancel();
  }
  const Status status = impl_->Translate(stream->Finish());
  return taken.ok() ? status : taken;
}

}  // namespace metaekf::client
