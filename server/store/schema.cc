#include "server/store/schema.h"

#include "core/base/status.h"

namespace metaekf::store {
namespace {

// Every key starts with the tenant. Times are microseconds since 1970; digests name blobs; what is
// called _json is text that the store does not look into.
constexpr const char* kTables[] = {
    // The last number given of each kind, so that none is ever given twice.
    R"(CREATE TABLE counters (
         tenant TEXT NOT NULL, kind TEXT NOT NULL, value INTEGER NOT NULL,
         PRIMARY KEY (tenant, kind)) STRICT, WITHOUT ROWID)",
    // What was made for a client's request_id, and from what (fingerprint).
    R"(CREATE TABLE request_ids (
         tenant TEXT NOT NULL, kind TEXT NOT NULL, request_id TEXT NOT NULL,
         fingerprint TEXT NOT NULL, name TEXT NOT NULL, number INTEGER NOT NULL,
         create_time INTEGER NOT NULL,
         PRIMARY KEY (tenant, kind, request_id)) STRICT, WITHOUT ROWID)",
    "CREATE INDEX request_ids_by_age ON request_ids (create_time)",
    // A model is there while it has a version.
    R"(CREATE TABLE versions (
         tenant TEXT NOT NULL, model TEXT NOT NULL, version INTEGER NOT NULL,
         digest TEXT NOT NULL, size_bytes INTEGER NOT NULL, metadata_json TEXT NOT NULL,
         create_time INTEGER NOT NULL,
         PRIMARY KEY (tenant, model, version)) STRICT, WITHOUT ROWID)",
    R"(CREATE TABLE aliases (
         tenant TEXT NOT NULL, model TEXT NOT NULL, alias TEXT NOT NULL, version INTEGER NOT NULL,
         PRIMARY KEY (tenant, model, alias),
         FOREIGN KEY (tenant, model, version) REFERENCES versions) STRICT, WITHOUT ROWID)",
    R"(CREATE TABLE adaptations (
         tenant TEXT NOT NULL, id TEXT NOT NULL, model TEXT NOT NULL, version INTEGER NOT NULL,
         digest TEXT NOT NULL, size_bytes INTEGER NOT NULL, receipt_json TEXT NOT NULL,
         create_time INTEGER NOT NULL,
         PRIMARY KEY (tenant, id),
         FOREIGN KEY (tenant, model, version) REFERENCES versions) STRICT, WITHOUT ROWID)",
    "CREATE INDEX adaptations_by_version ON adaptations (tenant, model, version)",
    // attempt is the fencing token; failures counts those in a row that got nowhere.
    R"(CREATE TABLE jobs (
         tenant TEXT NOT NULL, number INTEGER NOT NULL, model TEXT NOT NULL,
         spec_json TEXT NOT NULL, dataset_digest TEXT NOT NULL, state TEXT NOT NULL,
         attempt INTEGER NOT NULL DEFAULT 0, failures INTEGER NOT NULL DEFAULT 0,
         worker TEXT NOT NULL DEFAULT '', lease_end INTEGER NOT NULL DEFAULT 0,
         progress_json TEXT NOT NULL DEFAULT '', error TEXT NOT NULL DEFAULT '',
         result_version INTEGER NOT NULL DEFAULT 0, create_time INTEGER NOT NULL,
         start_time INTEGER NOT NULL DEFAULT 0, end_time INTEGER NOT NULL DEFAULT 0,
         PRIMARY KEY (tenant, number)) STRICT, WITHOUT ROWID)",
    "CREATE INDEX jobs_by_state ON jobs (state)",
    R"(CREATE TABLE sessions (
         tenant TEXT NOT NULL, number INTEGER NOT NULL, token_digest TEXT NOT NULL,
         target TEXT NOT NULL, settings BLOB NOT NULL, epoch INTEGER NOT NULL,
         durable_seq INTEGER NOT NULL DEFAULT 0, checkpoint BLOB NOT NULL DEFAULT x'',
         create_time INTEGER NOT NULL,
         PRIMARY KEY (tenant, number)) STRICT, WITHOUT ROWID)",
};

// Since format 2. A time of 0 is never.
constexpr const char* kSecurityTables[] = {
    R"(CREATE TABLE tokens (
         id TEXT PRIMARY KEY, digest TEXT NOT NULL UNIQUE, tenant TEXT NOT NULL,
         scope TEXT NOT NULL, note TEXT NOT NULL, create_time INTEGER NOT NULL,
         expire_time INTEGER NOT NULL, revoke_time INTEGER NOT NULL DEFAULT 0)
         STRICT, WITHOUT ROWID)",
    R"(CREATE TABLE audit (
         number INTEGER PRIMARY KEY AUTOINCREMENT, time INTEGER NOT NULL, tenant TEXT NOT NULL,
         identity TEXT NOT NULL, action TEXT NOT NULL, resource TEXT NOT NULL,
         detail TEXT NOT NULL) STRICT)",
    "CREATE INDEX audit_by_tenant ON audit (tenant, number)",
    R"(CREATE TRIGGER audit_is_not_changed BEFORE UPDATE ON audit
         BEGIN SELECT RAISE(ABORT, 'what was written down stays'); END)",
    R"(CREATE TRIGGER audit_is_not_removed BEFORE DELETE ON audit
         BEGIN SELECT RAISE(ABORT, 'what was written down stays'); END)",
};

absl::Status MakeSecurityTables(Connection& connection) {
  for (const char* table : kSecurityTables) METAEKF_RETURN_IF_ERROR(connection.Execute(table));
  return connection.Execute(absl::StrCat("PRAGMA user_version = ", kFormatVersion));
}

absl::Status MakeTables(Connection& connection) {
  int64_t tables = 0;
  METAEKF_RETURN_IF_ERROR(connection.Execute("SELECT count(*) FROM sqlite_schema", {},
                                             [&](const Row& row) { tables = row.Int(0); }));
  if (tables > 0) {
    return absl::FailedPreconditionError(
        "metaekf.db was not written by this program; give --data-dir another directory");
  }
  for (const char* table : kTables) METAEKF_RETURN_IF_ERROR(connection.Execute(table));
  return MakeSecurityTables(connection);
}

}  // namespace

absl::Status PrepareSchema(Database& database) {
  return database.Write([](Connection& connection) -> absl::Status {
    int64_t version = 0;
    METAEKF_RETURN_IF_ERROR(connection.Execute("PRAGMA user_version", {},
                                               [&](const Row& row) { version = row.Int(0); }));
    if (version == kFormatVersion) return absl::OkStatus();
    if (version == 0) return MakeTables(connection);
    if (version == 1) return MakeSecurityTables(connection);
    return absl::FailedPreconditionError(
        absl::StrCat("the data directory has format ", version, ", this server knows format ",
                     kFormatVersion, "; start the server that wrote it, or use another directory"));
  });
}

}  // namespace metaekf::store
