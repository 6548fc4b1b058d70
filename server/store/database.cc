#include "server/store/database.h"

#include <sqlite3.h>

#include <utility>

#include "core/base/status.h"

namespace metaekf::store {
namespace {

constexpr int kLockTimeoutMs = 5000;
// Open from the start, so that what a server holds does not depend on how many have once read at a time. Others are closed after use.
constexpr size_t kIdleReaders = 4;

int Bind(sqlite3_stmt* statement, int index, const Value& value) {
  if (const auto* number = std::get_if<int64_t>(&value)) {
    return sqlite3_bind_int64(statement, index, *number);
  }
  if (const auto* text = std::get_if<std::string_view>(&value)) {
    return sqlite3_bind_text64(statement, index, text->data(), text->size(), SQLITE_STATIC,
                               SQLITE_UTF8);
  }
  if (const auto* bytes = std::get_if<Bytes>(&value)) {
    return sqlite3_bind_blob64(statement, index, bytes->data.data(), bytes->data.size(),
                               SQLITE_STATIC);
  }
  return sqlite3_bind_null(statement, index);
}

}  // namespace

int64_t Row::Int(int column) const { return sqlite3_column_int64(statement_, column); }

std::string Row::Text(int column) const {
  const auto* data = static_cast<const char*>(sqlite3_column_blob(statement_, column));
  const auto size = static_cast<size_t>(sqlite3_column_bytes(statement_, column));
  return size == 0 ? std::string() : std::string(data, size);
}

absl::StatusOr<std::unique_ptr<Connection>> Connection::Open(const std::string& path, Mode mode) {
  sqlite3* handle = nullptr;
  const int flags = SQLITE_OPEN_NOMUTEX | SQLITE_OPEN_READWRITE |
                    (mode == Mode::kReadWrite ? SQLITE_OPEN_CREATE : 0);
  const int code = sqlite3_open_v2(path.c_str(), &handle, flags, nullptr);
  std::unique_ptr<Connection> connection(new Connection(handle));
  if (code != SQLITE_OK) return connection->Error(code);
  sqlite3_busy_timeout(handle, kLockTimeoutMs);
  METAEKF_RETURN_IF_ERROR(connection->Execute("PRAGMA foreign_keys = ON"));
  METAEKF_RETURN_IF_ERROR(connection->Execute("PRAGMA synchronous = FULL"));
  // KiB of pages that a connection keeps, where SQLite would let each grow to 2 MB. What is missed the kernel has.
  METAEKF_RETURN_IF_ERROR(connection->Execute(mode == Mode::kReadOnly ? "PRAGMA cache_size = -64" : "PRAGMA cache_size = -256"));
  if (mode == Mode::kReadOnly) METAEKF_RETURN_IF_ERROR(connection->Execute("PRAGMA query_only = ON"));
  return connection;
}

Connection::~Connection() {
  for (const auto& [sql, statement] : statements_) sqlite3_finalize(statement);
  sqlite3_close(handle_);
}

absl::Status Connection::Error(int code) const {
  const std::string message = absl::StrCat("database: ", sqlite3_errmsg(handle_));
  // A used-up quota or file size limit is reported as a failed write.
  if (code == SQLITE_FULL || sqlite3_extended_errcode(handle_) == SQLITE_IOERR_WRITE) {
    return absl::ResourceExhaustedError(
        absl::StrCat(message, "; make room on the data directory's disk"));
  }
  switch (code) {
    case SQLITE_CORRUPT:
    case SQLITE_NOTADB:
      return absl::DataLossError(message);
    case SQLITE_CANTOPEN:
    case SQLITE_PERM:
    case SQLITE_READONLY:
      return absl::FailedPreconditionError(message);
    case SQLITE_BUSY:
      return absl::UnavailableError(message);
    default:
      return absl::InternalError(message);
  }
}

absl::StatusOr<sqlite3_stmt*> Connection::Prepare(const std::string& sql) {
  sqlite3_stmt*& statement = statements_[sql];
  if (statement == nullptr) {
    const int code = sqlite3_prepare_v3(handle_, sql.c_str(), static_cast<int>(sql.size()),
                                        SQLITE_PREPARE_PERSISTENT, &statement, nullptr);
    if (code != SQLITE_OK) return Error(code);
  }
  return statement;
}

absl::Status Connection::Execute(const std::string& sql, std::initializer_list<Value> parameters,
                                 const std::function<void(const Row&)>& on_row) {
  METAEKF_ASSIGN_OR_RETURN(sqlite3_stmt* const statement, Prepare(sql));
  int index = 0;
  for (const Value& value : parameters) {
    if (const int code = Bind(statement, ++index, value); code != SQLITE_OK) return Error(code);
  }
  int code = sqlite3_step(statement);
  for (; code == SQLITE_ROW; code = sqlite3_step(statement)) {
    if (on_row) on_row(Row(statement));
  }
  const absl::Status status = code == SQLITE_DONE ? absl::OkStatus() : Error(code);
  sqlite3_reset(statement);
  sqlite3_clear_bindings(statement);
  return status;
}

absl::Status Connection::CopyTo(const std::string& path) {
  METAEKF_ASSIGN_OR_RETURN(const std::unique_ptr<Connection> copy, Open(path, Mode::kReadWrite));
  sqlite3_backup* backup = sqlite3_backup_init(copy->handle_, "main", handle_, "main");
  if (backup == nullptr) return copy->Error(sqlite3_errcode(copy->handle_));
  const int step = sqlite3_backup_step(backup, -1);
  const int finish = sqlite3_backup_finish(backup);
  if (step == SQLITE_DONE && finish == SQLITE_OK) return absl::OkStatus();
  return copy->Error(finish == SQLITE_OK ? step : finish);
}

int64_t Connection::changes() const { return sqlite3_changes64(handle_); }

absl::Status Connection::Transact(const char* begin,
                                  const std::function<absl::Status(Connection&)>& work) {
  METAEKF_RETURN_IF_ERROR(Execute(begin));
  absl::Status status = work(*this);
  if (status.ok()) status = Execute("COMMIT");
  // Some errors, such as a full disk, have rolled back already.
  if (!status.ok() && sqlite3_get_autocommit(handle_) == 0) {
    Execute("ROLLBACK").IgnoreError();  // the first error is the one to tell
  }
  return status;
}

absl::StatusOr<std::unique_ptr<Database>> Database::Open(const std::string& path) {
  METAEKF_ASSIGN_OR_RETURN(auto writer, Connection::Open(path, Connection::Mode::kReadWrite));
  METAEKF_RETURN_IF_ERROR(writer->Execute("PRAGMA journal_mode = WAL"));
  std::string verdict;
  METAEKF_RETURN_IF_ERROR(
      writer->Execute("PRAGMA quick_check(1)", {}, [&](const Row& row) { verdict = row.Text(0); }));
  if (verdict != "ok") return absl::DataLossError(absl::StrCat("database: damaged: ", verdict));
  std::unique_ptr<Database> database(new Database(path, std::move(writer)));
  for (size_t i = 0; i < kIdleReaders; ++i) {
    METAEKF_ASSIGN_OR_RETURN(auto reader, Connection::Open(path, Connection::Mode::kReadOnly));
    METAEKF_RETURN_IF_ERROR(reader->Execute("SELECT count(*) FROM sqlite_schema"));  // opens its files
    database->idle_readers_.push_back(std::move(reader));
  }
  return database;
}

absl::Status Database::WriteTransaction(const Transaction& work) {
  std::lock_guard lock(writer_mutex_);
  return writer_->Transact("BEGIN IMMEDIATE", work);
}

absl::Status Database::ReadTransaction(const Transaction& work) {
  std::unique_ptr<Connection> reader;
  {
    std::lock_guard lock(readers_mutex_);
    if (!idle_readers_.empty()) {
      reader = std::move(idle_readers_.back());
      idle_readers_.pop_back();
    }
  }
  if (!reader) {
    METAEKF_ASSIGN_OR_RETURN(reader, Connection::Open(path_, Connection::Mode::kReadOnly));
  }
  const absl::Status status = reader->Transact("BEGIN", work);
  std::lock_guard lock(readers_mutex_);
  if (idle_readers_.size() < kIdleReaders) idle_readers_.push_back(std::move(reader));
  return status;
}

absl::Status Database::CopyTo(const std::string& path, const Transaction& at_commit) {
  std::unique_lock no_writes(writer_mutex_);
  return ReadTransaction([&](Connection& connection) -> absl::Status {
    METAEKF_RETURN_IF_ERROR(at_commit(connection));
    no_writes.unlock();  // what is written from here on, this transaction does not see
    return connection.CopyTo(path);
  });
}

}  // namespace metaekf::store
