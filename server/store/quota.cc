#include "server/store/quota.h"

#include <filesystem>

#include "core/base/status.h"
#include "server/store/context.h"

namespace metaekf::store {
namespace {

absl::StatusOr<int64_t> Ask(const Context& context, Connection& connection, const std::string& sql) {
  int64_t value = 0;
  METAEKF_RETURN_IF_ERROR(
      connection.Execute(sql, {context.tenant}, [&](const Row& row) { value = row.Int(0); }));
  return value;
}

absl::Status CheckCount(const Context& context, Connection& connection, const std::string& what,
                        const std::string& rows, int64_t limit, const std::string& remedy) {
  if (limit == Quota::kNoLimit) return absl::OkStatus();
  METAEKF_ASSIGN_OR_RETURN(
      const int64_t count,
      Ask(context, connection, absl::StrCat("SELECT count(*) FROM ", rows, " AND tenant = ?1")));
  if (count < limit) return absl::OkStatus();
  return absl::ResourceExhaustedError(absl::StrCat("tenant '", context.tenant, "' has ", count, " ",
                                                   what, ", and its quota is ", limit, "; ", remedy));
}

}  // namespace

absl::Status CheckMaySession(const Context& context, Connection& connection) {
  return CheckCount(context, connection, "sessions", "sessions WHERE true", context.quota.sessions,
                    "delete those that are not needed");
}

absl::Status CheckMayAdaptation(const Context& context, Connection& connection) {
  return CheckCount(context, connection, "adaptations", "adaptations WHERE true",
                    context.quota.adaptations, "delete those that are not needed");
}

absl::Status CheckMayQueueJob(const Context& context, Connection& connection) {
  return CheckCount(context, connection, "jobs that wait", "jobs WHERE state = 'QUEUED'",
                    context.quota.queued_jobs, "try again when one of them has begun, or cancel one");
}

absl::Status CheckMayStore(const Context& context, Connection& connection, int64_t added) {
  const int64_t limit = context.quota.stored_bytes;
  if (limit == Quota::kNoLimit) return absl::OkStatus();
  METAEKF_ASSIGN_OR_RETURN(
      int64_t stored,
      Ask(context, connection,
          "SELECT total(size_bytes) FROM (SELECT size_bytes FROM versions WHERE tenant = ?1 "
          "UNION ALL SELECT size_bytes FROM adaptations WHERE tenant = ?1)"));
  METAEKF_RETURN_IF_ERROR(connection.Execute(
      "SELECT dataset_digest FROM jobs WHERE tenant = ?1 AND state IN ('QUEUED', 'RUNNING')",
      {context.tenant}, [&](const Row& row) {
        std::error_code missing;  // is not stored
        const uintmax_t size = std::filesystem::file_size(context.blobs.Path(row.Text(0)), missing);
        if (!missing) stored += static_cast<int64_t>(size);
      }));
  if (added <= limit && stored <= limit - added) return absl::OkStatus();
  return absl::ResourceExhaustedError(absl::StrCat(
      "tenant '", context.tenant, "' has ", stored, " bytes stored, this would add ", added,
      ", and its quota is ", limit, "; delete versions or adaptations that are not needed"));
}

}  // namespace metaekf::store
