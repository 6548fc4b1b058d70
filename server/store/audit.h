#pragma once

#include <cstdint>
#include <string>

#include "server/store/context.h"
#include "server/store/page.h"

namespace metaekf::store {

/// Who did what, when.
struct AuditEntry {
  int64_t number = 0;  ///< from 1 up
  absl::Time time;
  std::string tenant;
  std::string identity;  ///< of the client: its token or certificate
  std::string action;    ///< the method's name
  std::string resource;  ///< what was made, changed or used
  std::string detail;
};

/// Writes down what context.identity does, in the transaction that does it: what is told happened,
/// and what happened is told.
absl::Status Audit(const Context& context, Connection& connection, const std::string& action,
                   const std::string& resource, const std::string& detail = "");

/// The entries of all tenants; the database lets none be changed or removed. Safe to call
/// concurrently.
class AuditLog {
 public:
  explicit AuditLog(Context context) : context_(std::move(context)) {}

  /// Newest first. @param tenant  whose entries; empty: all.
  absl::StatusOr<Page<AuditEntry>> List(const PageRequest& request, const std::string& tenant);

 private:
  Context context_;
};

}  // namespace metaekf::store
