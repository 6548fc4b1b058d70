#pragma once

#include <cblas.h>

namespace metaekf::linalg {

/// Threads come from a `base::Executor` alone, and results must not depend on their number: whoever calls OpenBLAS includes
/// this.
inline const bool kBlasIsSingleThreaded = [] {
  openblas_set_num_threads(1);
  return true;
}();

}  // namespace metaekf::linalg
