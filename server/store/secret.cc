#include "server/store/secret.h"

#include <sys/random.h>

#include <cerrno>

#include "absl/strings/escaping.h"
#include "server/store/files.h"

namespace metaekf::store {

absl::StatusOr<std::string> NewSecret() {
  std::string bytes(32, '\0');
  if (getrandom(bytes.data(), bytes.size(), 0) != static_cast<ssize_t>(bytes.size())) {
    return ErrnoStatus(errno, "cannot draw random bytes");
  }
  return absl::BytesToHexString(bytes);
}

}  // namespace metaekf::store
