#pragma once

/// Before a loop over so few vectors that they stay in registers, which they do only if it is unrolled.
#ifdef __clang__
#define METAEKF_UNROLL _Pragma("clang loop unroll(full)")
#else
#define METAEKF_UNROLL _Pragma("GCC unroll 8")
#endif
