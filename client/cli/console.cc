#include "client/cli/console.h"

#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>

#include "absl/strings/ascii.h"
#include "core/base/status.h"

namespace metaekf::cli {
namespace {

constexpr char kUsage[] = "metaekf/usage";

/// Where to look for what was not found.
std::string Hint(const client::Status& status) {
  if (status.reason == "NO_SERVER") {
    return "; start one with: metaekfd --data-dir DIR --listen " + status.metadata.at("server");
  }
  if (status.code != client::Code::kNotFound) return "";
  for (const std::string kind : {"adaptation", "job", "model"}) {
    if (status.message.find(kind) != std::string::npos) {
      return absl::StrCat("; see: metaekf ", kind, "s list");
    }
  }
  return "";
}

/// Whether HOST:PORT is of this machine whatever a name server says.
bool IsThisMachine(const std::string& server) {
  const std::string host = server.substr(0, server.rfind(':'));
  return host == "localhost" || host == "[::1]" ||
         (host.rfind("127.", 0) == 0 && host.find_first_not_of("0123456789.") == std::string::npos);
}

}  // namespace

absl::Status Console::TakeAccess() {
  if (!access.token_file.empty()) {
    METAEKF_ASSIGN_OR_RETURN(const std::string text, ReadFile(access.token_file));
    options_.token = std::string(absl::StripAsciiWhitespace(text));
    if (options_.token.empty()) return UsageError(absl::StrCat(access.token_file, " holds no token"));
  } else if (const char* given = std::getenv("METAEKF_TOKEN"); given != nullptr) {
    options_.token = given;
  }
  if (access.tls_cert.empty() != access.tls_key.empty()) {
    return UsageError("--tls-cert and --tls-key go together: give both or neither");
  }
  if (access.tls || !access.tls_ca.empty() || !access.tls_cert.empty()) {
    options_.tls.emplace();
    const std::pair<const std::string&, std::string&> files[] = {
        {access.tls_ca, options_.tls->authorities},
        {access.tls_cert, options_.tls->certificate},
        {access.tls_key, options_.tls->key}};
    for (const auto& [path, text] : files) {
      if (path.empty()) continue;
      METAEKF_ASSIGN_OR_RETURN(text, ReadFile(path));
    }
  }
  if (!options_.token.empty() && !options_.tls && !IsThisMachine(server)) {
    return UsageError(absl::StrCat("the token would go to ", server,
                                   " unencrypted, for others to read: give --tls, or --tls-ca FILE"));
  }
  return absl::OkStatus();
}

client::Client& Console::client() {
  if (!client_) {
    options_.server = server;
    client_ = std::make_unique<client::Client>(options_);
  }
  return *client_;
}

absl::Status ToAbsl(const client::Status& status) {
  return absl::Status(static_cast<absl::StatusCode>(status.code), status.message + Hint(status));
}

absl::Status UsageError(const std::string& message) {
  absl::Status status = absl::InvalidArgumentError(message);
  status.SetPayload(kUsage, absl::Cord());
  return status;
}

bool IsUsageError(const absl::Status& status) { return status.GetPayload(kUsage).has_value(); }

absl::StatusOr<std::string> ReadFile(const std::string& path) {
  std::error_code ignored;
  std::ifstream file(path, std::ios::binary);
  if (!file) return absl::NotFoundError(absl::StrCat("cannot read ", path, ": ", strerror(errno)));
  if (std::filesystem::is_directory(path, ignored)) {
    return absl::NotFoundError(absl::StrCat("cannot read ", path, ": it is a directory"));
  }
  return std::string(std::istreambuf_iterator<char>(file), {});
}

absl::Status WriteFile(const std::string& path, const std::string& text) {
  std::ofstream file(path, std::ios::binary);
  if (!file) return absl::NotFoundError(absl::StrCat("cannot write ", path, ": ", strerror(errno)));
  file << text;
  file.close();
  if (!file) {
    return absl::DataLossError(absl::StrCat("writing ", path, " failed; is the disk full?"));
  }
  return absl::OkStatus();
}

}  // namespace metaekf::cli
