#pragma once

#include <istream>
#include <memory>
#include <ostream>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "metaekf/client.h"

namespace metaekf::cli {

enum class Format { kTable, kJson, kCsv };

/// What every command works with: its streams, the global options, the connection.
class Console {
 public:
  Console(std::istream& input, std::ostream& output, std::ostream& errors, bool errors_to_terminal)
      : in(input), out(output), err(errors), err_is_terminal(errors_to_terminal) {}

  /// Reads what `access` names, and METAEKF_TOKEN. Errors: those of ReadFile; UsageError for an empty file of a token,
  /// half a certificate, or a token that would be sent through a network unencrypted.
  absl::Status TakeAccess();

  /// The connection, made when it is first needed.
  client::Client& client();

  std::istream& in;
  std::ostream& out;  ///< results, nothing else
  std::ostream& err;  ///< everything else
  bool err_is_terminal;
  std::string server = "127.0.0.1:50051";
  struct Access {
    std::string token_file;
    bool tls = false;
    std::string tls_ca, tls_cert, tls_key;
  } access;  ///< files; empty: none
  Format format = Format::kTable;
  bool format_given = false;

 private:
  client::Options options_;
  std::unique_ptr<client::Client> client_;
};

/// A status of the client library as the command line's own: same code; a message that says what to
/// do where that is known (no server, no such model).
absl::Status ToAbsl(const client::Status& status);

template <typename T>
absl::StatusOr<T> ToAbsl(client::Result<T> result) {
  if (!result.ok()) return ToAbsl(result.status());
  return std::move(*result);
}

/// An InvalidArgument that ends the program with status 2: the command line itself is wrong.
absl::Status UsageError(const std::string& message);
bool IsUsageError(const absl::Status& status);

/// Reads a whole file, or writes one. Errors: NotFound or DataLoss with the path and the reason.
absl::StatusOr<std::string> ReadFile(const std::string& path);
absl::Status WriteFile(const std::string& path, const std::string& text);

}  // namespace metaekf::cli
