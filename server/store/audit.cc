#include "server/store/audit.h"

#include <vector>

#include "core/base/status.h"

namespace metaekf::store {

absl::Status Audit(const Context& context, Connection& connection, const std::string& action,
                   const std::string& resource, const std::string& detail) {
  return connection.Execute(
      "INSERT INTO audit (time, tenant, identity, action, resource, detail) "
      "VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
      {absl::ToUnixMicros(context.clock()), context.tenant, context.identity, action, resource,
       detail});
}

absl::StatusOr<Page<AuditEntry>> AuditLog::List(const PageRequest& request,
                                                const std::string& tenant) {
  const std::string list = absl::StrCat("audit/", tenant);
  METAEKF_ASSIGN_OR_RETURN(const PageCursor cursor, ParsePage(list, request));
  return context_.database.Read([&](Connection& connection) -> absl::StatusOr<Page<AuditEntry>> {
    std::vector<AuditEntry> entries;
    METAEKF_RETURN_IF_ERROR(connection.Execute(
        "SELECT number, time, tenant, identity, action, resource, detail FROM audit "
        "WHERE (?1 = '' OR tenant = ?1) AND number < ?2 ORDER BY number DESC LIMIT ?3",
        {tenant, NumberLimit(cursor), cursor.size + 1}, [&](const Row& row) {
          entries.push_back({row.Int(0), absl::FromUnixMicros(row.Int(1)), row.Text(2), row.Text(3),
                             row.Text(4), row.Text(5), row.Text(6)});
        }));
    return MakePage(list, cursor, std::move(entries),
                    [](const AuditEntry& entry) { return absl::StrCat(entry.number); });
  });
}

}  // namespace metaekf::store
