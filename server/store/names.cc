#include "server/store/names.h"

#include <algorithm>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"

namespace metaekf::store {
namespace {

constexpr size_t kMaxLength = 63;

bool IsLetterOrDigit(char c) { return absl::ascii_islower(c) || absl::ascii_isdigit(c); }

}  // namespace

absl::Status CheckName(const std::string& what, const std::string& name) {
  const bool valid = !name.empty() && name.size() <= kMaxLength && IsLetterOrDigit(name[0]) &&
                     std::all_of(name.begin(), name.end(),
                                 [](char c) { return IsLetterOrDigit(c) || c == '_' || c == '-'; });
  if (valid) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat(what, " '", name.substr(0, kMaxLength + 1),
                   "' is not 1 to 63 of a-z, 0-9, _ and -, starting with a letter or digit"));
}

absl::Status CheckAlias(const std::string& alias) {
  if (absl::Status status = CheckName("alias", alias); !status.ok()) return status;
  if (absl::ascii_islower(alias[0])) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("alias '", alias, "' does not start with a letter a-z"));
}

}  // namespace metaekf::store
