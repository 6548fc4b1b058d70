#pragma once

#include <atomic>
#include <cstddef>

// Counts the calls of malloc (operator new and Eigen end there) of the whole program. Include in one source of a
// test. The sanitizers bring their own malloc: there METAEKF_COUNTS_ALLOCATIONS is 0.
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define METAEKF_COUNTS_ALLOCATIONS 0
#elif defined(__has_feature)
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer)
#define METAEKF_COUNTS_ALLOCATIONS 0
#endif
#endif
#ifndef METAEKF_COUNTS_ALLOCATIONS
#define METAEKF_COUNTS_ALLOCATIONS 1

namespace metaekf::support {
inline std::atomic<long> allocations{0};
}

extern "C" void* __libc_malloc(size_t size);
extern "C" void* malloc(size_t size) noexcept {
  metaekf::support::allocations.fetch_add(1, std::memory_order_relaxed);
  return __libc_malloc(size);
}
#endif
