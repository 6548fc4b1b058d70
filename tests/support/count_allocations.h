#pragma once

#include <atomic>
#include <cstddef>

#include "tests/support/sanitized.h"

// Counts the calls of malloc (operator new and Eigen end there) of the whole program. Include in one source of a
// test. Where METAEKF_SANITIZED nothing is counted.
#if !METAEKF_SANITIZED
namespace metaekf::support {
inline std::atomic<long> allocations{0};
}

extern "C" void* __libc_malloc(size_t size);
extern "C" void* malloc(size_t size) noexcept {
  metaekf::support::allocations.fetch_add(1, std::memory_order_relaxed);
  return __libc_malloc(size);
}
#endif
