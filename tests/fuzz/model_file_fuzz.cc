#include <cstdlib>
#include <string>

#include "core/nssm/model_file.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  const auto bundle = metaekf::nssm::ReadModelFile(std::string(reinterpret_cast<const char*>(data), size));
  if (!bundle.ok()) return 0;
  const std::string written = metaekf::nssm::WriteModelFile(*bundle);
  const auto again = metaekf::nssm::ReadModelFile(written);
  if (!again.ok() || metaekf::nssm::WriteModelFile(*again) != written) std::abort();
  return 0;
}
