#include "server/store/context.h"

#include "core/base/status.h"

namespace metaekf::store {
namespace {

constexpr const char* kReferenced =
    "SELECT digest FROM versions UNION SELECT digest FROM adaptations "
    "UNION SELECT dataset_digest FROM jobs WHERE state IN ('QUEUED', 'RUNNING')";

}  // namespace

absl::StatusOr<int64_t> NextNumber(const Context& context, Connection& connection,
                                   const std::string& kind) {
  int64_t number = 0;
  METAEKF_RETURN_IF_ERROR(
      connection.Execute("INSERT INTO counters VALUES (?1, ?2, 1) "
                         "ON CONFLICT DO UPDATE SET value = value + 1 RETURNING value",
                         {context.tenant, kind}, [&](const Row& row) { number = row.Int(0); }));
  return number;
}

absl::StatusOr<std::vector<std::string>> ReferencedBlobs(Connection& connection) {
  std::vector<std::string> digests;
  METAEKF_RETURN_IF_ERROR(
      connection.Execute(kReferenced, {}, [&](const Row& row) { digests.push_back(row.Text(0)); }));
  return digests;
}

void RemoveIfUnreferenced(const Context& context, const std::string& digest) {
  context.database
      .Write([&](Connection& connection) -> absl::Status {
        bool referenced = false;
        METAEKF_RETURN_IF_ERROR(
            connection.Execute(absl::StrCat("SELECT 1 FROM (", kReferenced, ") WHERE digest = ?1"),
                               {digest}, [&](const Row&) { referenced = true; }));
        if (!referenced) context.blobs.Remove(digest);
        return absl::OkStatus();
      })
      .IgnoreError();
}

}  // namespace metaekf::store
