#pragma once

#include <cstdlib>
#include <string>

namespace metaekf::testing {

/// Whether METAEKF_FAULTS=long asks for the full number of faults: deploy/test --full does.
inline bool LongFaults() {
  const char* given = std::getenv("METAEKF_FAULTS");
  return given != nullptr && std::string(given) == "long";
}

}  // namespace metaekf::testing
