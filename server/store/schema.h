#pragma once

#include "absl/status/status.h"
#include "server/store/database.h"

namespace metaekf::store {

/// The format of a data directory, kept in the database's user_version. Raise it with every change
/// of the tables or of the directory's layout, and bring older ones up to date in PrepareSchema.
constexpr int64_t kFormatVersion = 2;

/// Makes the tables in a new database, and what lacks in one of an earlier format.
/// Errors: FailedPrecondition if the format is later than kFormatVersion or the tables are someone else's.
absl::Status PrepareSchema(Database& database);

}  // namespace metaekf::store
