#pragma once

#include <cstdint>
#include <functional>
#include <initializer_list>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

struct sqlite3;
struct sqlite3_stmt;

namespace metaekf::store {

struct Bytes {
  std::string_view data;
};
/// A parameter of a statement. Views need to live until Execute returns.
using Value = std::variant<std::nullptr_t, int64_t, std::string_view, Bytes>;

/// A row of a result; columns count from 0, NULL reads as 0 or "".
class Row {
 public:
  explicit Row(sqlite3_stmt* statement) : statement_(statement) {}
  int64_t Int(int column) const;
  std::string Text(int column) const;  ///< TEXT or BLOB

 private:
  sqlite3_stmt* statement_;
};

/// One connection to an SQLite database; for one thread at a time. Statements are prepared once.
class Connection {
 public:
  enum class Mode { kReadWrite, kReadOnly };
  static absl::StatusOr<std::unique_ptr<Connection>> Open(const std::string& path, Mode mode);
  ~Connection();

  /// Runs one statement with parameters ?1, ?2, … and calls `on_row` for every row of its result.
  /// Errors: ResourceExhausted when the disk is full, DataLoss for a damaged file,
  /// FailedPrecondition if it cannot be opened or written, Unavailable if it is locked from
  /// outside, Internal.
  absl::Status Execute(const std::string& sql, std::initializer_list<Value> parameters = {},
                       const std::function<void(const Row&)>& on_row = nullptr);
  /// Writes all that the current transaction sees into a new database.
  absl::Status CopyTo(const std::string& path);
  /// Rows that the last INSERT, UPDATE or DELETE changed.
  int64_t changes() const;

  /// Runs `work` between `begin` and COMMIT; rolls back if it or the commit fails.
  absl::Status Transact(const char* begin, const std::function<absl::Status(Connection&)>& work);

 private:
  explicit Connection(sqlite3* handle) : handle_(handle) {}
  absl::StatusOr<sqlite3_stmt*> Prepare(const std::string& sql);
  absl::Status Error(int code) const;

  sqlite3* handle_;
  std::map<std::string, sqlite3_stmt*> statements_;
};

/// A database of one writer and any number of readers, in WAL mode: readers see the last commit and
/// neither wait for the writer nor make it wait. Every commit is on disk when it returns.
class Database {
 public:
  /// Errors: as Connection::Execute; DataLoss if the file does not pass SQLite's own check.
  static absl::StatusOr<std::unique_ptr<Database>> Open(const std::string& path);

  /// Runs `work`, which takes the connection and returns an absl::Status or StatusOr, in a
  /// transaction that alone may write; commits if that is OK. Returns what `work` returned, or why
  /// the commit failed.
  template <class Work>
  auto Write(const Work& work) {
    return Run(&Database::WriteTransaction, work);
  }
  /// As Write, on a snapshot that cannot be written.
  template <class Work>
  auto Read(const Work& work) {
    return Run(&Database::ReadTransaction, work);
  }

  using Transaction = std::function<absl::Status(Connection&)>;

  /// Writes the last commit into a new database. `at_commit`, which must read something, runs before any later write does.
  absl::Status CopyTo(const std::string& path, const Transaction& at_commit);

 private:

  Database(std::string path, std::unique_ptr<Connection> writer)
      : path_(std::move(path)), writer_(std::move(writer)) {}

  absl::Status WriteTransaction(const Transaction& work);
  absl::Status ReadTransaction(const Transaction& work);

  template <class Work>
  std::invoke_result_t<Work, Connection&> Run(absl::Status (Database::*run)(const Transaction&),
                                              const Work& work) {
    std::invoke_result_t<Work, Connection&> result = absl::UnknownError("not run");
    absl::Status status = (this->*run)([&](Connection& connection) -> absl::Status {
      result = work(connection);
      if constexpr (std::is_same_v<decltype(result), absl::Status>) {
        return result;
      } else {
        return result.status();
      }
    });
    if (!status.ok()) return status;
    return result;
  }

  const std::string path_;
  std::mutex writer_mutex_;
  std::unique_ptr<Connection> writer_;
  std::mutex readers_mutex_;
  std::vector<std::unique_ptr<Connection>> idle_readers_;
};

}  // namespace metaekf::store
