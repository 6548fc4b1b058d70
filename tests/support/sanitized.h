#pragma once

// METAEKF_SANITIZED: whether a sanitizer adds memory and time of its own to what is measured, and brings its own malloc.
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define METAEKF_SANITIZED 1
#elif defined(__has_feature)
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer)
#define METAEKF_SANITIZED 1
#endif
#endif
#ifndef METAEKF_SANITIZED
#define METAEKF_SANITIZED 0
#endif
