#include "client/cli/console.h"

#include <cerrno>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>

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

}  // namespace

client::Client& Console::client() {
  if (!client_) client_ = std::make_unique<client::Client>(client::Options{.server = server});
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
