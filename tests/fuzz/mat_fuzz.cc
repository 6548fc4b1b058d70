#include <sys/mman.h>
#include <unistd.h>

#include <cstdlib>
#include <sstream>
#include <string>

#include "client/cli/mat_file.h"
#include "core/data/csv.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  static const int file = memfd_create("input.mat", MFD_CLOEXEC);
  static const std::string path = "/proc/self/fd/" + std::to_string(file);
  if (ftruncate(file, 0) != 0 || pwrite(file, data, size, 0) != static_cast<ssize_t>(size)) std::abort();
  const auto text = metaekf::cli::ReadMatFileAsCsv(path);
  if (!text.ok()) return 0;
  std::istringstream stream(*text);
  (void)metaekf::data::ReadCsv(stream, "input", {.allow_missing_outputs = true});
  return 0;
}
