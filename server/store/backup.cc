#include "server/store/backup.h"

#include <filesystem>

namespace metaekf::store {

Backup::~Backup() {
  std::error_code ignored;  // the next start tries again
  std::filesystem::remove_all(directory_, ignored);
}

}  // namespace metaekf::store
