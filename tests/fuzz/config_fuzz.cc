#include <string>

#include "server/access/exposure.h"
#include "server/config/read_config.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  metaekf::server::ServerOptions options;
  if (metaekf::server::ApplyConfig(std::string(reinterpret_cast<const char*>(data), size), &options).ok()) {
    (void)metaekf::server::CheckExposure(options);
  }
  return 0;
}
