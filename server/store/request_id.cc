#include "server/store/request_id.h"

#include "core/base/status.h"

namespace metaekf::store {
namespace {

constexpr size_t kMaxIdBytes = 128;
constexpr absl::Duration kMemory = absl::Hours(24 * 7);

}  // namespace

absl::StatusOr<std::optional<RequestResult>> FindRequest(const Context& context,
                                                         Connection& connection,
                                                         const std::string& kind,
                                                         const RequestId& request) {
  if (request.id.size() > kMaxIdBytes) {
    return absl::InvalidArgumentError(absl::StrCat("request_id has ", request.id.size(),
                                                   " bytes, at most ", kMaxIdBytes, " are taken"));
  }
  std::optional<RequestResult> result;
  std::string fingerprint;
  if (request.id.empty()) return result;
  METAEKF_RETURN_IF_ERROR(
      connection.Execute("SELECT fingerprint, name, number FROM request_ids "
                         "WHERE tenant = ?1 AND kind = ?2 AND request_id = ?3",
                         {context.tenant, kind, request.id}, [&](const Row& row) {
                           fingerprint = row.Text(0);
                           result = RequestResult{row.Text(1), row.Int(2)};
                         }));
  if (result && fingerprint != request.fingerprint) {
    return absl::AlreadyExistsError(absl::StrCat(
        "request_id '", request.id, "' was used for another request; give each its own"));
  }
  return result;
}

absl::Status RecordRequest(const Context& context, Connection& connection, const std::string& kind,
                           const RequestId& request, const RequestResult& result) {
  if (request.id.empty()) return absl::OkStatus();
  const absl::Time now = context.clock();
  METAEKF_RETURN_IF_ERROR(connection.Execute("DELETE FROM request_ids WHERE create_time < ?1",
                                             {absl::ToUnixMicros(now - kMemory)}));
  return connection.Execute("INSERT INTO request_ids VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)",
                            {context.tenant, kind, request.id, request.fingerprint, result.name,
                             result.number, absl::ToUnixMicros(now)});
}

}  // namespace metaekf::store
